"""OP3 as a whole: agreement with the naive twin, and the contract of models."""

from __future__ import annotations

import weakref
from typing import Any

import pytest
import torch
from torch import Tensor

from apex_lab.inference.predictor import joined
from apex_lab.models.op3 import Op3
from apex_lab.models.op3.decoder import Decoded, Decoder
from apex_lab.models.op3.posterior import RawGaussian
from apex_lab.models.op3.refinement import Memory, Refinement, Seen
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Context, Scene
from tests.reference.op3 import NaiveOp3

SIZE = 16


@pytest.fixture
def model() -> Op3:
    torch.manual_seed(0)
    return Op3(image_size=SIZE, slots=3, stochastic=8, deterministic=4, hidden=16)


@pytest.fixture
def video() -> Tensor:
    return torch.rand(2, 4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))


def context(first_frame: int = 0, videos: tuple[int, ...] = (5, 6), **fields: object) -> Context:
    return Context(noise=VideoNoise(0, videos, first_frame), **fields)  # type: ignore[arg-type]


def loss(scene: Scene) -> Tensor:
    return (scene.terms["nll"] + 0.01 * scene.terms["kl"]).mean()


def gradients(model: Op3) -> dict[str, Tensor]:
    found = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    model.zero_grad()
    return found


@pytest.mark.parametrize("weighting", ["segment", "linear"])
@pytest.mark.parametrize(("first", "later"), [(2, 1), (1, 2), (2, 0)])
def test_the_naive_twin_agrees(weighting: str, first: int, later: int, video: Tensor) -> None:
    torch.manual_seed(0)
    model = Op3(SIZE, 3, 8, 4, 16, 0.1, 0.05, first, later, weighting, loss_batch=7)  # type: ignore[arg-type]
    scene, twin = model(video, context()), NaiveOp3(model)(video, VideoNoise(0, (5, 6)))
    for name in Op3.term_names:
        torch.testing.assert_close(scene.terms[name], twin.terms[name], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(scene.masks, twin.masks, rtol=1e-4, atol=1e-5)
    total = (scene.terms["nll"] + model.beta * scene.terms["kl"]).mean()
    torch.testing.assert_close(total, twin.total, rtol=1e-5, atol=0)
    total.backward()
    found = gradients(model)
    twin.total.backward()
    wanted = gradients(model)
    assert found.keys() == wanted.keys()
    largest = max(float(g.abs().max()) for g in wanted.values())
    for name, gradient in wanted.items():
        # the scales of the norms have gradients that nearly cancel
        assert float((found[name] - gradient).abs().max()) <= 2e-3 * float(gradient.abs().max()) + 1e-6 * largest, name


def test_in_double_precision_the_naive_twin_agrees_to_rounding(video: Tensor) -> None:
    """Of single precision alone it would be hard to say whether 1e-4 is rounding."""
    torch.set_default_dtype(torch.float64)
    try:
        torch.manual_seed(0)
        model, frames = Op3(SIZE, 3, 8, 4, 16), video[:, :2].double()
        scene, twin = model(frames, context()), NaiveOp3(model)(frames, VideoNoise(0, (5, 6)))
        torch.testing.assert_close(scene.masks, twin.masks, rtol=0, atol=1e-12)
        loss(scene).backward()
        found = gradients(model)
        twin.total.backward()
    finally:
        torch.set_default_dtype(torch.float32)
    for name, wanted in gradients(model).items():
        torch.testing.assert_close(found[name], wanted, rtol=0, atol=1e-11 * float(wanted.abs().max()) + 1e-14)


def test_without_a_number_the_loss_is_divided_by_the_batch(video: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """op3.md section 4: dL/dm = -p / (P + 1e-12) / B and dL/dx = m p / (P + 1e-12) (x - y) / (3 sigma^2) / B."""
    seen: list[Seen] = []
    refine = Refinement.forward

    def watched(self: Refinement, looked_at: Seen, memory: Memory) -> tuple[RawGaussian, Memory]:
        seen.append(looked_at)
        return refine(self, looked_at, memory)

    monkeypatch.setattr(Refinement, "forward", watched)
    torch.manual_seed(0)
    model = Op3(SIZE, 3, 8, 4, 16, loss_batch=None)
    assert model.batch_statistics  # a share of the batch has another size
    assert not Op3(SIZE, 3, 8, 4, 16).batch_statistics
    for training, batch in ((True, 2), (False, 1)):
        seen.clear()
        model.train(training)(video, context())
        for step in seen:
            masks, density, total = step.mixture
            to_masks = -density / (total + 1e-12)[:, None] / batch
            torch.testing.assert_close(step.gradients.masks, to_masks)
            errors = step.colours - step.image[:, None]
            to_colours = -(masks * to_masks)[:, :, None] * errors / (3 * 0.1**2)
            torch.testing.assert_close(step.gradients.colours, to_colours)


def test_evaluation_is_the_same_computation_without_a_graph(model: Op3, video: Tensor) -> None:
    trained = model(video, context())
    with torch.no_grad():
        evaluated = model.eval()(video, context())
    assert trained.masks.requires_grad
    assert not evaluated.masks.requires_grad
    torch.testing.assert_close(evaluated.masks, trained.masks.detach())
    with torch.no_grad():
        torch.testing.assert_close(model.train()(video, context()).masks, evaluated.masks)


def test_evaluation_mode_has_gradients_where_they_are_on(model: Op3, video: Tensor) -> None:
    loss(model(video, context())).backward()
    wanted = gradients(model)
    loss(model.eval()(video, context())).backward()
    for name, gradient in gradients(model).items():
        torch.testing.assert_close(gradient, wanted[name])


def test_scene(model: Op3, video: Tensor) -> None:
    scene = model.eval()(video, context(detail=True))
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 4, SIZE, SIZE))
    assert not scene.background.any()
    assert scene.ids.tolist() == [[[0, 1, 2]] * 4] * 2
    assert (scene.presence == 1).all()
    assert scene.appearance.shape == (2, 4, 3, 12)
    assert scene.windows is None
    assert scene.means is not None
    assert scene.means.shape == (2, 4, 3, 3, SIZE, SIZE)
    for image in (scene.means, scene.reconstruction):
        assert 0 <= float(image.min()) <= float(image.max()) <= 1
    assert scene.terms.keys() == set(Op3.term_names)
    assert model(video, context()).means is None
    assert scene.diagnostics.keys() == {"nll_predicted", "nll_refined"}
    assert model(video[:, :1], context()).diagnostics.keys() == {"nll_refined"}


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_chunks_give_what_the_whole_gives(model: Op3, video: Tensor, cut: int) -> None:
    model.eval()
    whole = model(video, context())
    first = model(video[:, :cut], context())
    second = model(video[:, cut:], context(cut, state=first.state))
    torch.testing.assert_close(torch.cat([first.masks, second.masks], 1), whole.masks)
    torch.testing.assert_close(torch.cat([first.appearance, second.appearance], 1), whole.appearance)
    together = joined([first, second])
    torch.testing.assert_close(together.terms, whole.terms)
    assert together.terms_weight == pytest.approx(whole.terms_weight)
    assert second.state.frames == 4
    torch.testing.assert_close(second.state.sample, whole.state.sample)


def test_the_weight_of_the_terms_is_the_sum_of_the_steps_weights(model: Op3, video: Tensor) -> None:
    """Four refinements, then three times a prediction and two refinements (op3.md section 6)."""
    assert model.eval()(video, context()).terms_weight == 2.5 + 3 * 2.5


@pytest.mark.parametrize("frames", [3, 9])
def test_evaluation_keeps_no_more_of_a_frame_than_its_result(
    model: Op3, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the decoder's hidden layers, at most those of two steps are alive at any time, however long the video."""
    hidden: list[weakref.ref[Tensor]] = []
    alive: list[int] = []
    decode = Decoder.forward

    def watched(self: Decoder, *inputs: Any) -> Decoded:
        decoded = decode(self, *inputs)
        hidden.extend(weakref.ref(layer) for layer in decoded.hidden)
        alive.append(sum(layer() is not None for layer in hidden))
        return decoded

    monkeypatch.setattr(Decoder, "forward", watched)
    video = torch.rand(1, frames, 3, SIZE, SIZE)
    with torch.no_grad():
        scene = model.eval()(video, context(videos=(5,), detail=True))
    assert max(alive) == 2 * 4
    assert not any(layer() is not None for layer in hidden)
    # the result's tensors hold no larger ones that they are parts of
    for value in (scene.masks, scene.reconstruction, scene.means, scene.appearance):
        assert value is not None
        assert value.untyped_storage().nbytes() == value.numel() * value.element_size()


def test_a_video_does_not_depend_on_its_company(model: Op3, video: Tensor) -> None:
    together = model(video, context())
    alone = model(video[1:], context(videos=(6,)))
    torch.testing.assert_close(together.masks[1:], alone.masks, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(together.terms["nll"][1:], alone.terms["nll"], rtol=1e-4, atol=1e-3)


def test_evaluation_repeats_and_depends_on_the_noise(model: Op3, video: Tensor) -> None:
    model.eval()
    first = model(video, context())
    assert torch.equal(first.masks, model(video, context()).masks)
    assert not torch.equal(first.masks, model(video, context(videos=(7, 8))).masks)


def test_noise_alone_tells_slots_apart(model: Op3, video: Tensor) -> None:
    class Silent(VideoNoise):
        def normal(self, like: Tensor) -> Tensor:
            return torch.zeros_like(like)

        def at(self, frame: int, frames: int = 1) -> VideoNoise:
            return self

    masks = model.eval()(video, Context(noise=Silent(0, (5, 6)))).masks
    torch.testing.assert_close(masks, torch.full_like(masks, 1 / 3))


def test_gradients_reach_all_parameters(model: Op3, video: Tensor) -> None:
    loss(model(video, context())).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        if name != "refinement.norm_others.shift":  # rounds to zero at the start
            assert parameter.grad.any(), name


def test_one_frame_leaves_the_dynamics_alone(model: Op3, video: Tensor) -> None:
    loss(model(video[:, :1], context())).backward()
    assert all(parameter.grad is None for parameter in model.dynamics.parameters())


def test_bfloat16_runs(model: Op3, video: Tensor) -> None:
    with torch.autocast("cpu", torch.bfloat16):
        scene = model(video, context())
        loss(scene).backward()
        evaluated = model.eval()(video, context())
    assert scene.masks.dtype == evaluated.masks.dtype == torch.float32
    assert scene.terms["nll"].dtype == torch.float32
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
    torch.testing.assert_close(scene.masks[:, 0], model(video, context()).masks[:, 0], atol=0.1, rtol=0)


def test_other_image_sizes_are_refused(model: Op3) -> None:
    assert Op3.input_size is None
    assert model.input_size == (SIZE, SIZE)
    with pytest.raises(ValueError, match=r"built for images of \(16, 16\) px, the video has \(8, 8\)"):
        model(torch.rand(2, 1, 3, 8, 8), context())


def test_state_dict_holds_parameters_alone(model: Op3) -> None:
    assert set(model.state_dict()) == {name for name, _ in model.named_parameters()}


@pytest.mark.parametrize("schedule", ["single_step_physics", "curriculum"])
def test_other_schedules_train_and_evaluation_refines_every_frame(schedule: str, model: Op3, video: Tensor) -> None:
    torch.manual_seed(0)
    other = Op3(SIZE, 3, 8, 4, 16, schedule=schedule)  # type: ignore[arg-type]
    assert set(other.schedule_ranges) == ({"predictions"} if schedule == "curriculum" else set())
    values = {name: torch.tensor(2.0) for name in other.schedule_ranges}
    scene = other(video, context(schedule=values))
    assert scene.masks.shape == (2, 4, 3, SIZE, SIZE)
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 4, SIZE, SIZE))
    # the first frame's ramp of four refinements, and two or three predictions; one refinement after two
    assert scene.terms_weight == pytest.approx(2.5 + 3)
    loss(scene).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in other.parameters())
    torch.testing.assert_close(other.eval()(video, context()).masks, model.eval()(video, context()).masks)


def test_frames_beyond_the_curriculum_change_no_gradient(model: Op3, video: Tensor) -> None:
    curriculum = Op3(SIZE, 3, 8, 4, 16, schedule="curriculum")
    found = []
    for frames in (2, 4):
        loss(curriculum(video[:, :frames], context(schedule={"predictions": torch.tensor(1.0)}))).backward()
        found.append(gradients(curriculum))
    assert found[0].keys() == found[1].keys()
    for name, gradient in found[0].items():
        torch.testing.assert_close(found[1][name], gradient)

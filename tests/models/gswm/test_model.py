"""The whole model: the contract, chunks, batches, gradients, options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from apex_lab.config import components
from apex_lab.models.gswm import Gswm
from apex_lab.models.gswm.latents import Attributes
from apex_lab.scene import ABSENT, Scene
from tests.models.gswm.small import SIZE, context, double, loss, tiny, video

__all__ = ["double"]

CONF = Path(__file__).parents[3] / "conf"


def same(a: Scene, b: Scene, atol: float = 1e-4) -> None:
    torch.testing.assert_close(a.masks, b.masks, rtol=0, atol=atol)
    torch.testing.assert_close(a.reconstruction, b.reconstruction, rtol=0, atol=atol)
    assert torch.equal(a.ids, b.ids)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("background", [True, False])
def test_scene(training: bool, background: bool) -> None:
    model = tiny(background=background).train(training)
    scene = model(video(), context(detail=True))
    b, t, k = 3, 5, 5
    assert scene.masks.shape == (b, t, k, SIZE, SIZE)
    assert (scene.masks >= 0).all()
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(b, t, SIZE, SIZE))
    assert scene.background.tolist() == [False] * 4 + [True]
    assert tuple(scene.terms) == model.term_names
    assert all(value.shape == (b,) and value.isfinite().all() for value in scene.terms.values())
    for video_ids in scene.ids.flatten(0, 1).tolist():
        there = [i for i in video_ids if i != ABSENT]
        assert len(set(there)) == len(there)
    assert scene.windows is not None
    assert scene.windows.shape == (b, t, k, 4)
    assert scene.windows[:, :, :4].isfinite().all()
    assert scene.windows[:, :, 4].isnan().all()
    assert scene.means is not None
    assert scene.means.shape == (b, t, k, 3, SIZE, SIZE)
    assert scene.appearance.shape == (b, t, k, 5)
    assert ((scene.reconstruction >= 0) & (scene.reconstruction <= 1)).all()
    # what is drawn is what the masks mix, but that an object's image at its border is masked before it is pasted
    mixed = (scene.masks[:, :, :, None] * scene.means).sum(2)
    assert (mixed - scene.reconstruction).abs().mean() < 0.05
    if not background:
        assert (scene.terms["kl_background"] == 0).all()


def test_objects_come_stay_and_go() -> None:
    """The tiny model is of use: presences on both sides of 0.5, tracked and new objects, rejections."""
    scene = tiny().eval()(video(3, 6), context())
    objects = scene.presence[:, :, :4]
    assert 0.1 < (objects > 0.5).float().mean() < 0.95
    stays = (scene.ids[:, 1:, :4] == scene.ids[:, :-1, :4]).float().mean()
    assert 0.2 < stays < 0.98


def test_an_identity_keeps_its_slot_and_never_comes_back() -> None:
    ids = tiny().eval()(video(3, 8), context()).ids[:, :, :4]
    for of_video in ids:
        slots: dict[int, list[tuple[int, int]]] = {}
        for t, of_frame in enumerate(of_video.tolist()):
            for slot, identity in enumerate(of_frame):
                slots.setdefault(identity, []).append((t, slot))
        for identity, places in slots.items():
            if identity == ABSENT:
                continue
            frames = [t for t, _ in places]
            assert frames == list(range(frames[0], frames[-1] + 1))
            assert len({slot for _, slot in places}) == 1


@pytest.mark.parametrize("cut", [1, 3])
@pytest.mark.usefixtures("double")
def test_chunks_give_what_the_whole_gives(cut: int) -> None:
    model = tiny().eval()
    x = video(3, 7)
    whole = model(x, context())
    first = model(x[:, :cut], context())
    second = model(x[:, cut:], context(first=cut, state=first.state))
    for name in ("masks", "reconstruction", "presence", "appearance"):
        joined = torch.cat([getattr(first, name), getattr(second, name)], dim=1)
        torch.testing.assert_close(joined, getattr(whole, name), rtol=0, atol=1e-4)
    assert torch.equal(torch.cat([first.ids, second.ids], dim=1), whole.ids)
    for name in model.term_names:
        torch.testing.assert_close(first.terms[name] + second.terms[name], whole.terms[name], rtol=1e-4, atol=1e-3)


def test_a_video_does_not_depend_on_its_batch() -> None:
    model = tiny().eval()
    x = video()
    whole = model(x, context())
    alone = model(x[1:2], context((1,)))
    torch.testing.assert_close(alone.masks, whole.masks[1:2], rtol=0, atol=1e-4)
    assert torch.equal(alone.ids, whole.ids[1:2])
    for name in model.term_names:
        torch.testing.assert_close(alone.terms[name], whole.terms[name][1:2], rtol=1e-4, atol=1e-3)


def test_training_with_group_norm_does_not_depend_on_the_batch_either() -> None:
    model = tiny(norm="group")
    x = video()
    whole, alone = model(x, context()), model(x[2:], context((2,)))
    for name in model.term_names:
        torch.testing.assert_close(alone.terms[name], whole.terms[name][2:], rtol=1e-4, atol=1e-3)


def test_evaluation_repeats_and_samples() -> None:
    model = tiny().eval()
    same(model(video(), context()), model(video(), context()), atol=0)
    other = model(video(), context((5, 6, 7)))
    assert not torch.equal(other.masks, model(video(), context()).masks)


def test_means_in_evaluation() -> None:
    model = tiny(evaluation="mean").eval()
    same(model(video(), context()), model(video(), context((5, 6, 7))), atol=0)
    model.train()
    assert not torch.equal(model(video(), context()).masks, model(video(), context((5, 6, 7))).masks)


@pytest.mark.parametrize("environment", ["attention", "whole", "none"])
@pytest.mark.parametrize("draw", ["independent", "balanced"])
def test_gradients_reach_all_parameters(environment: Any, draw: Any) -> None:
    model = tiny(environment=environment, discovery_draw=draw)
    loss(model(video(), context()).terms).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


@pytest.mark.parametrize("background", [True, False])
def test_the_state_of_a_training_pass_holds_no_graph(background: bool) -> None:
    state = tiny(background=background).train()(video(2, 3), context((0, 1))).state
    tensors = [*(state.background or ()), state.slots.z, *state.slots.memory, state.slots.ids, state.slots.next_id]
    assert [x.requires_grad for x in tensors] == [False] * len(tensors)


@pytest.mark.parametrize(("environment", "passes"), [("whole", 1), ("attention", 5), ("none", 0)])
def test_a_whole_background_is_encoded_once_for_all_frames(environment: Any, passes: int) -> None:
    model, seen = tiny(environment=environment), []
    if environment != "none":
        model.history.encoder.register_forward_hook(lambda net, inputs, output: seen.append(len(inputs[0])))
    model(video(3, 5), context())
    assert len(seen) == passes
    assert sum(seen) == {"whole": 3 * 5, "attention": 3 * 5 * 4, "none": 0}[environment]


def test_without_gradients() -> None:
    model = tiny().eval()
    with torch.no_grad():
        scene = model(video(), context())
    same(scene, model(video(), context()))
    assert not scene.masks.requires_grad


def test_in_bfloat16() -> None:
    """Networks in bfloat16, latents and losses in single precision."""
    model = tiny()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scene = model(video(), context())
        total = loss(scene.terms)
    total.backward()
    assert scene.masks.dtype == torch.float32
    full = loss(model(video(), context()).terms)
    assert abs(total.item() - full.item()) < 0.3 * abs(full.item())


def test_background_only() -> None:
    """While it lasts, the background explains the image, objects cost nothing and learn nothing."""
    model = tiny()
    terms = model(video(), context(background_only=1.0)).terms
    assert model.background is not None
    for name in model.term_names[2:]:
        assert (terms[name] == 0).all(), name
    loss(terms).backward()
    assert any(p.grad is not None and p.grad.any() for p in model.background.parameters())
    assert not any(p.grad is not None and p.grad.any() for p in model.renderer.parameters())
    with_objects = model(video(), context()).terms
    assert not torch.equal(with_objects["nll"], terms["nll"])


def test_fixed_alpha() -> None:
    """At 0 nothing changes; above 0 objects share at most that much of a pixel."""
    model = tiny().eval()
    free, zero = (model(video(), context(**more)) for more in ({}, {"fixed_alpha": 0.0}))
    assert torch.equal(free.masks, zero.masks)
    scene = model(video(), context(fixed_alpha=0.25))
    assert not torch.equal(scene.masks, free.masks)
    assert scene.masks[:, :, :-1].sum(2).max() <= 0.25 + 1e-6  # the last is the background's


def test_fixed_alpha_takes_the_place_of_the_decoded_one() -> None:
    """A single object: a quarter of its colour, three quarters of the background, wherever its window is."""
    model = tiny()
    objects = Attributes(
        pres=torch.ones(2, 1, 1),
        depth=torch.zeros(2, 1, 1),
        where=torch.tensor([0.8, 0.8, 0.0, 0.0]).expand(2, 1, 4),
        what=torch.randn(2, 1, 5),
        dyna=torch.zeros(2, 1, 7),
    )
    backdrop = torch.rand(2, 3, SIZE, SIZE)
    drawn = model.renderer(objects, backdrop, detail=True, fixed_alpha=torch.tensor(0.25))
    assert drawn.means is not None
    inside = (slice(None), slice(None), slice(12, 20), slice(12, 20))
    torch.testing.assert_close(drawn.masks[inside], torch.full((2, 1, 8, 8), 0.25), atol=2e-4, rtol=0)
    torch.testing.assert_close(
        drawn.reconstruction[inside], 0.25 * drawn.means[:, 0][inside] + 0.75 * backdrop[inside], atol=2e-4, rtol=0
    )


def test_schedules_reach_their_terms() -> None:
    model = tiny().eval()
    base = model(video(), context()).terms

    def changed(**changes: float) -> set[str]:
        terms = model(video(), context(**changes)).terms
        return {name for name in terms if not torch.allclose(terms[name], base[name], rtol=1e-6)}

    assert changed(sigma=0.3) == {"nll"}
    assert changed(presence_prior=0.1) == {"kl_pres", "presence_cost"}
    assert changed(scale_mean=-2.0) == {"kl_where"}
    assert {"nll", "kl_what"} <= changed(temperature=2.0)
    assert set(model.schedule_ranges) == {
        "temperature",
        "presence_prior",
        "scale_mean",
        "sigma",
        "background_only",
        "fixed_alpha",
    }


def test_terms_are_sums_over_frames() -> None:
    """Twice the frames, about twice the KL that all cells pay in every frame."""
    model = tiny(background=False).eval()
    x = torch.zeros(1, 4, 3, SIZE, SIZE)
    short, long = (model(x[:, :t], context((0,))).terms["kl_dyna"] for t in (2, 4))
    assert 1.5 < (long / short).item() < 2.5


def test_class_attributes() -> None:
    assert Gswm.tracks
    assert Gswm.streams
    assert Gswm.needs_training
    assert not Gswm.has_posterior
    assert Gswm.input_size is None


@pytest.mark.parametrize(
    ("size", "files"),
    [
        (128, ["paper"]),
        (64, ["cpu", "cpu_for/p2d"]),
        (64, ["cpu", "cpu_for/sprites"]),
        (64, ["quickstart"]),
        (32, ["smoke"]),
    ],
)
def test_recipes_fit_the_model(size: int, files: list[str]) -> None:
    """Every scheduled value and loss term has an entry, and the model can be built and run."""
    nodes = [OmegaConf.load(CONF / f) for f in ("model/gswm.yaml", *(f"recipe/gswm/{file}.yaml" for file in files))]
    config: Any = OmegaConf.to_container(OmegaConf.merge({"data": {"image_size": size}}, *nodes), resolve=True)
    components.check(config["model"], "model")
    model = instantiate(config["model"], _convert_="all").eval()
    assert set(config["schedule"]) | set(model.optional_schedules) == set(model.schedule_ranges)
    assert set(config["loss"]) == set(model.term_names)
    assert config["clips"]["frames"]["values"] == sorted(config["clips"]["frames"]["values"])
    with torch.no_grad():
        scene = model(torch.rand(1, 2, 3, size, size), context((0,)))
    assert scene.masks.shape == (1, 2, model.max_objects + 1, size, size)

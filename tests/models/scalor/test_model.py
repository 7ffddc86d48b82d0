"""SCALOR as a whole: the contract, chunks, options."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apex_lab.models.scalor import Scalor
from apex_lab.scene import ABSENT, Context, Noise, Scene, schedule_at
from tests.models.scalor.small import SCHEDULE, clip, run, small


def total(scene: Scene) -> torch.Tensor:
    return sum(scene.terms.values(), torch.zeros(())).sum()


def same(a: Scene, b: Scene, rows: slice = slice(None)) -> None:
    assert a.ids.tolist() == b.ids[rows].tolist()
    torch.testing.assert_close(a.masks, b.masks[rows], rtol=0, atol=1e-4)
    torch.testing.assert_close(a.reconstruction, b.reconstruction[rows], rtol=0, atol=1e-4)
    torch.testing.assert_close(a.presence, b.presence[rows])
    torch.testing.assert_close(a.appearance, b.appearance[rows], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("training", [True, False])
def test_scene(training: bool) -> None:
    model = small().train(training)
    scene = run(model, clip(2, 3), detail=True)
    assert scene.masks.shape == (2, 3, 7, 32, 32)
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 3, 32, 32))
    assert 0 <= float(scene.masks.min()) <= float(scene.masks.max()) <= 1
    assert scene.background.tolist() == [False] * 6 + [True]
    assert set(scene.terms) == set(model.term_names)
    assert all(term.shape == (2,) and bool(torch.isfinite(term).all()) for term in scene.terms.values())
    absent = scene.ids == ABSENT
    assert bool((~absent[..., :-1]).any())
    assert float(scene.masks[absent].sum()) == 0
    assert float(scene.presence[absent].sum()) == 0
    for frame in scene.ids.flatten(0, 1).tolist():
        held = [k for k in frame if k != ABSENT]
        assert len(held) == len(set(held))
    assert scene.means is not None
    assert scene.means.shape == (2, 3, 7, 3, 32, 32)
    assert scene.windows is not None
    assert bool(scene.windows.isnan().all(-1)[absent].all())
    assert not bool(scene.windows[..., :-1, :].isnan().any(-1)[~absent[..., :-1]].any())
    assert scene.diagnostics.keys() >= {"live_objects", "window_size", "rejected_share"}


def test_costly_fields_only_when_asked_for() -> None:
    scene = run(small(), clip(1, 2))
    assert scene.windows is None
    assert scene.means is None


@pytest.mark.parametrize("training", [True, False])
def test_chunks_give_what_the_whole_gives(training: bool) -> None:
    model = small().train(training)
    video = clip(2, 7)
    with torch.no_grad():
        whole = run(model, video)
        first = run(model, video[:, :3])
        second = run(model, video[:, 3:], state=first.state, first=3)
    for name in ("masks", "ids", "reconstruction", "presence", "appearance"):
        joined = torch.cat([getattr(first, name), getattr(second, name)], dim=1)
        torch.testing.assert_close(joined, getattr(whole, name), rtol=1e-3, atol=1e-3)
    for name, term in whole.terms.items():
        torch.testing.assert_close(first.terms[name] + second.terms[name], term, rtol=1e-4, atol=1e-2)


def test_videos_do_not_see_each_other() -> None:
    model = small().eval()
    video = clip(3, 4)
    with torch.no_grad():
        together = run(model, video)
        for i in range(3):
            same(run(model, video[i : i + 1], names=[i]), together, slice(i, i + 1))


def test_gradients_reach_all_parameters() -> None:
    model = small()
    total(run(model, clip(2, 4))).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert float(parameter.grad.abs().sum()) > 0, name


@pytest.mark.parametrize("recompute", ["objects", "everything"])
def test_recomputing_changes_nothing(recompute: str) -> None:
    video, results = clip(2, 4), []
    for level in ("nothing", recompute):
        model = small(recompute=level)
        loss = total(run(model, video))
        loss.backward()
        results.append((loss.detach(), [p.grad for p in model.parameters()]))
    torch.testing.assert_close(results[0][0], results[1][0])
    for a, b in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(a.abs().max()) + 1e-6)


@pytest.mark.parametrize("curriculum", [0.0, 1.0])
def test_drawing_after_the_loop_changes_nothing(monkeypatch: pytest.MonkeyPatch, curriculum: float) -> None:
    """A GPU and half precision draw with gradients after the loop, a CPU in it."""
    video, found = clip(2, 4), []
    for fast in (True, False):
        if not fast:
            for name in ("models.scalor.rollout", "models.scalor.glimpses", "models.scalor.discovery", "nn.celu_stack"):
                monkeypatch.setattr(f"apex_lab.{name}.fast_on", lambda x: False)
        model = small(recompute="objects").double()
        scene = run(model, video.double(), alpha_curriculum=curriculum)
        total(scene).backward()
        found.append([*(x.detach() for x in scene.terms.values()), scene.masks, *(p.grad for p in model.parameters())])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6 * float(a.abs().max()) + 1e-9)


def test_training_pass_without_gradients_is_the_same() -> None:
    """Without gradients all candidates are drawn, in the loop; with them only those that are present."""
    model, video = small(), clip(2, 4)
    with torch.no_grad():
        plain = run(model, video)
    same(run(model, video), plain)


def test_means_repeat_whatever_the_noise() -> None:
    model = small(latents="means").eval()
    video = clip(2, 3)
    with torch.no_grad():
        first, second = (model(video, Context(schedule_at(SCHEDULE), Noise())) for _ in range(2))
    same(first, second)


def test_samples_in_evaluation_differ_with_the_noise() -> None:
    model = small().eval()
    video = clip(1, 3)
    with torch.no_grad():
        first, second = (model(video, Context(schedule_at(SCHEDULE), Noise())) for _ in range(2))
    assert not torch.equal(first.appearance, second.appearance)


def test_alpha_curriculum_silences_the_background() -> None:
    model, video = small(), clip(2, 3)
    loss = run(model, video, alpha_curriculum=1.0).terms["nll"].sum()
    gradients = torch.autograd.grad(loss, list(model.background.decoder.parameters()), allow_unused=True)
    assert all(g is None or float(g.abs().max()) == 0 for g in gradients)


def test_gradient_between_frames_stops_on_demand() -> None:
    """The tracker of slots reads the frame before; only with `slot_gradient` a loss of the last frame gets there."""
    found = []
    for flow in (0.0, 1.0):
        model = small()
        gradient = torch.autograd.grad(
            run(model, clip(2, 2), slot_gradient=flow).terms["nll"].sum(), list(model.objects.discovery.parameters())
        )
        found.append(sum(float(g.abs().sum()) for g in gradient))
    assert found[0] != found[1]


def test_objects_end_when_they_have_been_absent() -> None:
    """Presence 0.7 per frame: absence 0.3, then 0.6, which is not below the limit of 0.6 any more."""
    model = small().eval()
    with torch.no_grad():
        last = model.objects.propagation.presence[-1]
        last.weight.zero_()
        last.bias.fill_(-5.0)  # propagated objects are absent at once
        scene = run(model, clip(1, 4))
    for before, after in zip(scene.ids[0, :-1].tolist(), scene.ids[0, 1:].tolist(), strict=True):
        assert not {k for k in before[:-1] if k > 0} & {k for k in after[:-1] if k > 0}


def test_overlay_readout_is_hard() -> None:
    with torch.no_grad():
        scene = run(small(readout="overlay").eval(), clip(2, 3))
    assert set(scene.masks.unique().tolist()) <= {0.0, 1.0}
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 3, 32, 32))


def test_training_renders_at_most_max_objects() -> None:
    model = small(max_objects=3)
    scene = run(model, clip(2, 4))
    assert float(scene.diagnostics["live_objects"]) <= 3
    assert scene.masks.shape[2] == 4


def test_bfloat16_autocast() -> None:
    model = small()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scene = run(model, clip(2, 3), detail=True)
    total(scene).backward()
    assert bool(torch.isfinite(total(scene)))
    assert scene.masks.dtype == torch.float32


@pytest.mark.parametrize(
    "arguments", [{"image_size": 64, "grid": 8, "glimpse_size": 32}, {"image_size": 32, "grid": 8, "glimpse_size": 32}]
)
def test_other_sizes(arguments: dict[str, Any]) -> None:
    model = small(**arguments)
    scene = run(model, clip(1, 2, arguments["image_size"]))
    assert bool(torch.isfinite(total(scene)))


def test_one_frame() -> None:
    scene = run(small(), clip(2, 1))
    assert scene.masks.shape[1] == 1
    assert bool(torch.isfinite(total(scene)))


def test_refuses_videos_of_another_size() -> None:
    with pytest.raises(ValueError, match="the model was built for 32 px images"):
        run(small(), clip(1, 1, 64))


def test_published_values_are_the_defaults() -> None:
    model = Scalor()
    assert (model.sigma, model.objects.track, model.objects.propagation.stop) == (0.1, 0.7, 0.6)
    assert (model.objects.max_objects, model.objects.discovery.grid, model.image_size) == (45, 8, 128)
    rule = model.objects.rejection
    assert (rule.alpha, rule.explained, rule.ratio) == (0.3, 0.1, 0.3)

"""What must not matter: the order of cells and slots, the rest of the batch, the future; through the whole loop."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import apex_lab.models.apex.loop as module
from apex_lab.models.apex.objects import Proposals
from apex_lab.models.apex.slots import Carried, carry
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import Scene
from tests.models.apex.small import CONTEXT, Inside, lively, tiny, video

TERMS = ("nll", "kl_what", "kl_where", "kl_pres", "kl_background", "mask_entropy")


def by_identity(scene: Scene) -> list[list[dict[int, Tensor]]]:
    """Mask of every object of every frame of every video, under its identity."""
    ids = scene.ids[..., :-1]
    return [
        [
            {int(i): scene.masks[b, t, k] for k, i in enumerate(ids[b, t].tolist()) if i != -1}
            for t in range(ids.shape[1])
        ]
        for b in range(ids.shape[0])
    ]


def same_objects(a: Scene, b: Scene) -> None:
    first, second = by_identity(a), by_identity(b)
    for frames in zip(first, second, strict=True):
        for one, other in zip(*frames, strict=True):
            assert one.keys() == other.keys()
            for identity, mask in one.items():
                torch.testing.assert_close(mask, other[identity], rtol=0, atol=1e-9)
    for name in TERMS:
        torch.testing.assert_close(a.terms[name], b.terms[name], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(a.reconstruction, b.reconstruction, rtol=0, atol=1e-9)


@pytest.mark.parametrize("slots", [3, 8])
def test_permuting_slots_after_every_frame_permutes_the_objects_and_changes_nothing_else(
    slots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, x = lively(max_objects=slots, render_top=3).double().eval(), video(2, 5).double()
    with torch.no_grad():
        base = model(x, CONTEXT)
        order = torch.randperm(slots, generator=torch.Generator().manual_seed(1))
        assert order.tolist() != list(range(slots))

        def shuffled(*args: object) -> Carried:
            kept = carry(*args)  # type: ignore[arg-type]
            return Carried(kept.source[:, order], kept.valid[:, order], kept.ids[:, order], kept.next_id)

        monkeypatch.setattr(module, "carry", shuffled)
        other = model(x, CONTEXT)
    assert not torch.equal(base.ids, other.ids)
    same_objects(base, other)


@pytest.mark.parametrize("render_top", [4, None])
def test_permuting_the_discovery_cells_changes_nothing(render_top: int | None) -> None:
    model, x = lively(render_top=render_top).double().eval(), video(2, 5).double()
    order = torch.randperm(16, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        base = model(x, CONTEXT)
        discover = model.discovery.forward

        def shuffled(*args: object) -> Proposals:
            found = discover(*args)  # type: ignore[arg-type]
            fields = [
                Gaussian(f.mean[:, order], f.std[:, order]) if isinstance(f, Gaussian) else f[:, order] for f in found
            ]
            return Proposals(*fields)  # type: ignore[arg-type]

        model.discovery.forward = shuffled  # type: ignore[method-assign]
        other = model(x, CONTEXT)
    assert len({i for video_ids in base.ids.tolist() for frame in video_ids for i in frame}) > 5
    same_objects(base, other)


def test_priors_know_only_the_past() -> None:
    """Another frame 2 changes what is inferred in frame 2 and expected in frame 3, not what is expected in frame 2."""
    model, x = lively().double().eval(), video(2, 4).double()
    y = x.clone()
    y[:, 2] = torch.rand(y[:, 2].shape, generator=torch.Generator().manual_seed(3)).double()
    with torch.no_grad():
        a, b = Inside(model, x), Inside(model, y)
    first, second = a.steps.propagated, b.steps.propagated
    alive = a.steps.alive[:, 2]
    assert alive.any()
    assert torch.equal(alive, b.steps.alive[:, 2])
    for name in ("p_what", "p_where"):
        for p, q in zip(getattr(first, name), getattr(second, name), strict=True):
            assert torch.equal(p[:, 2], q[:, 2]), name
            assert not torch.equal(p[:, 3], q[:, 3]), name
    assert torch.equal(first.p_pres[:, 2], second.p_pres[:, 2])
    for name in ("q_what", "q_where"):
        assert not torch.equal(getattr(first, name).mean[:, 2][alive], getattr(second, name).mean[:, 2][alive]), name
    assert not torch.equal(first.q_pres[:, 2], second.q_pres[:, 2])


def test_the_background_s_prior_is_standard_normal_first_and_then_knows_the_frame_before() -> None:
    model = tiny()
    z = torch.randn(2, 4, 6)
    changed = z.clone()
    changed[:, 1] += 1
    with torch.no_grad():
        a, b = model.background.prior(z), model.background.prior(changed)
    assert (a.mean[:, 0] == 0).all()
    assert (a.std[:, 0] == 1).all()
    same = [torch.equal(a.mean[:, t], b.mean[:, t]) for t in range(4)]
    assert same == [True, True, False, True]


@pytest.mark.parametrize("term", TERMS)
def test_no_term_of_a_video_has_a_gradient_in_another_video(term: str) -> None:
    model, x = lively().eval(), video().requires_grad_()
    terms = model(x, CONTEXT).terms
    (gradient,) = torch.autograd.grad(terms[term][1], x)
    assert gradient[1].abs().sum() > 0
    assert (gradient[[0, 2]] == 0).all()


def test_a_video_s_scene_is_the_same_beside_other_videos() -> None:
    model = lively().double().eval()
    x, y = video().double(), 1 - video().double()
    with torch.no_grad():
        a = model(x, CONTEXT)
        b = model(torch.cat([y[:1], x[1:2], y[2:], x[2:]]), CONTEXT)
    assert torch.equal(a.ids[1], b.ids[1])
    torch.testing.assert_close(a.masks[1], b.masks[1], rtol=0, atol=1e-10)
    for name in TERMS:
        torch.testing.assert_close(a.terms[name][1], b.terms[name][1], rtol=1e-10, atol=1e-10)

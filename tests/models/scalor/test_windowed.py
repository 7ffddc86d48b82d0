"""Composition window by window against dense pastes, by number."""

from __future__ import annotations

import torch
from torch import Tensor

from apex_lab.models.scalor.composition import layers_of, paster_of
from apex_lab.models.scalor.discovery import Rejection
from apex_lab.models.scalor.windowed import overlaps, places_of, squares
from apex_lab.nn.spatial_transformer import crop, for_paste, sampled_crop

SIZE, GLIMPSE = 32, 16
DOUBLE = {"rtol": 1e-10, "atol": 1e-12}


def windows(frames: int = 2, count: int = 6, seed: int = 0) -> Tensor:
    """Small and large ones, some across the border, the last one of each frame outside of the image."""
    g = torch.Generator().manual_seed(seed)
    sizes = 0.05 + 1.1 * torch.rand(frames, count, 2, generator=g, dtype=torch.float64)
    centres = 2.4 * torch.rand(frames, count, 2, generator=g, dtype=torch.float64) - 1.2
    sizes[:, -1], centres[:, -1] = 0.2, 1.5
    return torch.cat([sizes, centres], dim=-1)


def dense_layers(drawn: Tensor, presence: Tensor, depth: Tensor, where: Tensor, counted: Tensor) -> list[Tensor]:
    """The sums as they are written down in `Layers`."""
    near = torch.sigmoid(-depth)[..., None, None]
    alpha = drawn[:, :, 3:] * presence[..., None, None, None]
    paster = paster_of(where, GLIMPSE, SIZE)
    mask, colour = paster.each(alpha)[:, :, 0], paster.each(drawn[:, :, :3] * alpha)
    kappa = near * mask
    return [
        (counted[..., None, None] * mask).sum(1),
        kappa.sum(1),
        (kappa[:, :, None] * colour).sum(1),
        (kappa * mask).sum(1).detach(),
    ]


def test_layers_and_their_gradients() -> None:
    g = torch.Generator().manual_seed(1)
    drawn = torch.rand(2, 6, 4, GLIMPSE, GLIMPSE, generator=g, dtype=torch.float64)
    presence = torch.rand(2, 6, generator=g, dtype=torch.float64)
    depth = torch.randn(2, 6, generator=g, dtype=torch.float64)
    counted = torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0, 0.0], dtype=torch.float64).expand(2, 6)
    inputs = [x.requires_grad_() for x in (drawn, presence, depth, windows())]
    found = []
    for compose in (dense_layers, lambda *x: list(layers_of(*x, SIZE))):
        layers = compose(*inputs, counted)
        given = [torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=x.dtype) for x in layers[:3]]
        found.append([*layers, *torch.autograd.grad(layers[:3], inputs, given)])
    for dense, windowed in zip(*found, strict=True):
        torch.testing.assert_close(windowed, dense, **DOUBLE)


def test_absent_components_take_no_part() -> None:
    drawn = torch.rand(1, 2, 4, GLIMPSE, GLIMPSE).requires_grad_()
    presence, others = torch.tensor([[1.0, 0.0]]), torch.ones(1, 2)
    where = windows(1, 3)[:, :2].float()
    both = layers_of(drawn, presence, others, where, others, SIZE)
    one = layers_of(drawn[:, :1], presence[:, :1], others[:, :1], where[:, :1], others[:, :1], SIZE)
    for a, b in zip(both, one, strict=True):
        assert torch.equal(a, b)
    gradient = torch.autograd.grad(both.colour.sum() + both.alpha.sum(), drawn)[0]
    assert float(gradient[:, 0].abs().max()) > 0
    assert float(gradient[:, 1].abs().max()) == 0


def test_nothing_to_see() -> None:
    drawn = torch.rand(1, 1, 4, GLIMPSE, GLIMPSE).requires_grad_()
    one = torch.ones(1, 1)
    layers = layers_of(drawn, one, one, windows(1, 1).float(), one, SIZE)
    assert all(float(x.detach().abs().max()) == 0 for x in layers)
    assert float(torch.autograd.grad(layers.alpha.sum(), drawn)[0].abs().max()) == 0


def test_overlaps_and_squares() -> None:
    g = torch.Generator().manual_seed(3)
    glimpses = torch.rand(2, 6, GLIMPSE, GLIMPSE, generator=g, dtype=torch.float64)
    among = (torch.rand(2, SIZE, SIZE, generator=g) > 0.5).double()
    where = windows()
    maps = paster_of(where, GLIMPSE, SIZE).each(glimpses[:, :, None])[:, :, 0]
    places = places_of(for_paste(where), SIZE)
    mine, shared = overlaps(glimpses, places, 0.3, among)
    pixels = (maps > 0.3).double()
    assert torch.equal(mine, pixels.sum((2, 3)))
    assert torch.equal(shared, (pixels * among[:, None]).sum((2, 3)))
    factors = torch.rand(2, 6, generator=g, dtype=torch.float64)
    found = squares(glimpses, factors, places)
    torch.testing.assert_close(found, factors[..., None, None] * maps.square(), **DOUBLE)


def test_proposals_that_reach_nothing_explained_are_kept() -> None:
    explained = torch.zeros(2, SIZE, SIZE, dtype=torch.float64)
    explained[0, :8, :8] = 0.5  # none in the second frame
    where, rejection = windows(2, 40), Rejection()
    asked = rejection.in_question(where, explained, GLIMPSE)
    kept = rejection.kept(torch.ones(2, 40, GLIMPSE, GLIMPSE, dtype=torch.float64), where, explained)
    assert bool(kept[~asked].all())
    assert 0 < int(asked[0].sum()) < 40
    assert not bool(asked[1].any())
    assert not bool(kept[asked].all())


def test_sampled_crop_and_its_gradient() -> None:
    images = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    where = windows().requires_grad_()
    dense, sampled = crop(images, where, GLIMPSE), sampled_crop(images, where, GLIMPSE)
    torch.testing.assert_close(sampled, dense, **DOUBLE)
    given = torch.randn_like(dense)
    a, b = (torch.autograd.grad(x, where, given)[0] for x in (dense, sampled))
    torch.testing.assert_close(b, a, **DOUBLE)

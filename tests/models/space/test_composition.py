"""Crops, pastes, the composition of cells and the boundary loss (space.md sections 3, 4 and 7)."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.space import composition
from apex_lab.models.space.composition import boundary_kernel, boundary_loss, compose
from apex_lab.models.space.latents import for_paste
from apex_lab.nn.spatial_transformer import Paster, crop
from tests.models.space.common import close, published


def windows_yx(where: Tensor) -> Tensor:
    """(sx, sy, tx, ty) as published -> (s_y, s_x, t_y, t_x)."""
    return where[:, [1, 0, 3, 2]]


def test_crops_are_the_published_ones() -> None:
    arrays = published()
    found = crop(arrays["stn_image"], windows_yx(arrays["stn_z_where"])[:, None], 8)
    close(found.squeeze(1), arrays["stn_fwd_8"])


def test_pastes_are_the_published_ones() -> None:
    arrays = published()
    paster = Paster(for_paste(windows_yx(arrays["stn_z_where"])), 8, 16)
    close(paster.each(arrays["stn_glimpse"]), arrays["stn_inv_16"])


def random_cells(seed: int = 0, cells: int = 4, dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    """Mask, colour, depth and windows of two images, all with gradients."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    windows = torch.cat([0.2 + rand(2, cells, 2), 1.5 * rand(2, cells, 2) - 0.75], dim=-1)
    found = (0.1 * rand(2, cells, 1, 8, 8), rand(2, cells, 3, 8, 8), rand(2, cells) - 0.5, windows)
    return tuple(x.requires_grad_() for x in found)


def plain(mask: Tensor, colour: Tensor, depth: Tensor, windows: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Section 4 word for word: logits in glimpse space, then pastes, then the softmax."""
    paster = Paster(for_paste(windows), mask.shape[-1], size)
    importance = paster.each(100 * mask * torch.sigmoid(-depth)[..., None, None, None])
    weight = importance.softmax(dim=1)
    shares = weight * paster.each(mask)
    return shares.squeeze(2), shares.sum(1), (weight * paster.each(mask * colour)).sum(1)


@pytest.mark.parametrize("cached", [2**22, 4096])
def test_composition_and_its_gradient_equal_the_plain_equations(cached: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apex_lab.nn.splitting.CACHED", cached)  # 4096: strips of a few rows of one image
    mask, colour, depth, windows = inputs = random_cells(dtype=torch.float32)
    found = compose(mask, colour, depth, Paster(for_paste(windows), 8, 16))
    shares, alpha, mean = plain(*inputs, 16)
    close(found.shares, shares, 1e-5)
    close(found.alpha, alpha.squeeze(1), 1e-5)
    close(found.mean, mean, 1e-5)
    weigh = torch.rand(2, 4, 16, 16)
    ours = torch.autograd.grad((weigh * torch.cat([found.alpha[:, None], found.mean], 1)).sum(), inputs)
    theirs = torch.autograd.grad((weigh * torch.cat([alpha, mean], 1)).sum(), inputs)
    for a, b in zip(ours, theirs, strict=True):
        close(a, b, 1e-4)


def test_gradient_of_the_composition_equals_finite_differences() -> None:
    mask, colour, depth, windows = random_cells()
    glimpses = torch.cat([mask, mask * colour], dim=2).detach().requires_grad_()
    paster = Paster(for_paste(windows.detach()), 8, 8)
    strength = (composition.IMPORTANCE * torch.sigmoid(-depth)).detach().requires_grad_()
    weights = [w.detach().requires_grad_() for w in (paster.w_y, paster.w_x)]
    assert torch.autograd.gradcheck(
        lambda *args: composition._Compose.apply(*args)[0], (glimpses, strength, *weights), fast_mode=True
    )


def test_a_cell_alone_competes_with_all_that_do_not_cover_a_pixel() -> None:
    mask = torch.zeros(1, 64, 1, 8, 8)
    mask[:, 0] = 0.05
    windows = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(1, 64, 4)
    found = compose(mask, torch.ones(1, 64, 3, 8, 8), torch.zeros(1, 64), Paster(windows, 8, 16))
    weight = math.exp(2.5) / (math.exp(2.5) + 63)
    assert weight == pytest.approx(0.16, abs=0.005)
    assert found.alpha[0, 8, 8].item() == pytest.approx(0.05 * weight, rel=1e-4)


def test_the_nearer_cell_wins() -> None:
    mask = torch.full((1, 4, 1, 8, 8), 0.9)
    windows = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(1, 4, 4)
    found = compose(mask, torch.ones(1, 4, 3, 8, 8), torch.tensor([[0.0, -2.0, 1.0, 0.5]]), Paster(windows, 8, 16))
    assert found.shares[0, :, 8, 8].argmax() == 1


def test_boundary_kernel_is_the_published_one() -> None:
    close(boundary_kernel(), published()["boundary_kernel"])


def boundary(presence: float, alpha: float, size: int) -> Tensor:
    """Of one window as large as the image."""
    windows = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(1, 1, 4)
    foreground = torch.full((1, size, size), alpha)
    return boundary_loss(boundary_kernel(), torch.full((1, 1), presence), foreground, Paster(windows, 32, size))


def test_boundary_loss_of_nothing_is_its_constant() -> None:
    assert boundary(1.0, 0.0, 128).item() == pytest.approx(9212.1, abs=0.1)
    assert boundary(0.0, 1.0, 128).item() == pytest.approx(9212.1, abs=0.1)


def test_boundary_loss_counts_the_rim_of_a_window() -> None:
    rim = 0.5 * (1000 / 1024 / 0.7) ** 2 * (32**2 - 20**2)
    assert (boundary(1.0, 1.0, 32) - boundary(1.0, 0.0, 32)).item() == pytest.approx(rim, rel=1e-4)

"""Crop and paste against affine_grid + grid_sample, round trips, and gradients by finite differences."""

import pytest
import torch
import torch.nn.functional as F

from apex_lab.nn.spatial_transformer import Paster, _triangle, crop, for_paste, paste, pixel_centres, window_of


def windows(n: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    size = 0.05 + 0.9 * torch.rand(n, 2, generator=generator, dtype=dtype)
    centre = 2 * torch.rand(n, 2, generator=generator, dtype=dtype) - 1
    return torch.cat([size, centre], dim=-1)


def sampled(image: torch.Tensor, window: torch.Tensor, size: int, inverse: bool) -> torch.Tensor:
    """The same by PyTorch's own spatial transformer."""
    s_y, s_x, t_y, t_x = window.unbind(-1)
    zero = torch.zeros_like(s_y)
    if inverse:
        rows = [torch.stack([1 / s_x, zero, -t_x / s_x], -1), torch.stack([zero, 1 / s_y, -t_y / s_y], -1)]
    else:
        rows = [torch.stack([s_x, zero, t_x], -1), torch.stack([zero, s_y, t_y], -1)]
    grid = F.affine_grid(torch.stack(rows, 1), [len(window), image.shape[1], size, size], align_corners=False)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_crop_equals_grid_sample(dtype: torch.dtype, tolerance: float) -> None:
    g = torch.Generator().manual_seed(0)
    image = torch.randn(3, 2, 20, 28, generator=g, dtype=dtype)
    window = windows(15, g, dtype).reshape(3, 5, 4)
    got = crop(image, window, 7)
    want = sampled(image.repeat_interleave(5, 0), window.flatten(0, 1), 7, inverse=False).unflatten(0, (3, 5))
    torch.testing.assert_close(got, want, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_paste_equals_grid_sample(dtype: torch.dtype, tolerance: float) -> None:
    g = torch.Generator().manual_seed(1)
    glimpse = torch.randn(12, 3, 8, 8, generator=g, dtype=dtype)
    window = windows(12, g, dtype)
    got = paste(glimpse, window, 24)
    torch.testing.assert_close(got, sampled(glimpse, window, 24, inverse=True), rtol=0, atol=tolerance)


def test_total_is_the_sum_of_the_pastes() -> None:
    g = torch.Generator().manual_seed(2)
    glimpse = torch.randn(2, 5, 8, 8, generator=g, dtype=torch.float64)
    paster = Paster(windows(10, g).reshape(2, 5, 4), 8, 16)
    torch.testing.assert_close(paster.total(glimpse), paster.each(glimpse[:, :, None]).sum(1)[:, 0])


def test_inside_is_a_pasted_glimpse_of_ones() -> None:
    g = torch.Generator().manual_seed(3)
    window = windows(6, g)
    rows, columns = Paster(window, 8, 16).inside()
    ones = paste(torch.ones(6, 1, 8, 8, dtype=torch.float64), window, 16)[:, 0]
    torch.testing.assert_close(rows[:, :, None] * columns[:, None, :], ones)


def test_the_whole_image_is_the_identity() -> None:
    image = torch.randn(1, 3, 16, 16, dtype=torch.float64)
    whole = torch.tensor([[[1.0, 1.0, 0.0, 0.0]]], dtype=torch.float64)
    torch.testing.assert_close(crop(image, whole, 16)[:, 0], image)
    torch.testing.assert_close(paste(image, whole[0], 16), image)


def test_round_trip_reproduces_a_smooth_image() -> None:
    axis = pixel_centres(32, torch.zeros((), dtype=torch.float64))
    smooth = torch.exp(-4 * (axis[:, None] ** 2 + (axis[None] - 0.2) ** 2))[None, None]
    window = torch.tensor([[[0.7, 0.6, 0.1, 0.15]]], dtype=torch.float64)
    back = paste(crop(smooth, window, 32)[:, 0], window[:, 0], 32)
    inside = paste(torch.ones(1, 1, 32, 32, dtype=torch.float64), window[:, 0], 32) > 0.999
    assert inside.sum() > 300
    assert (back - smooth)[inside].abs().max() < 0.01
    assert (back[paste(torch.ones(1, 1, 32, 32, dtype=torch.float64), window[:, 0], 32) == 0] == 0).all()


def test_gradients_by_finite_differences() -> None:
    g = torch.Generator().manual_seed(4)
    image = torch.randn(1, 1, 9, 9, generator=g, dtype=torch.float64, requires_grad=True)
    glimpse = torch.randn(2, 1, 5, 5, generator=g, dtype=torch.float64, requires_grad=True)
    window = windows(2, g).requires_grad_()
    assert torch.autograd.gradcheck(lambda i, w: crop(i, w[None], 4), (image, window))
    assert torch.autograd.gradcheck(lambda x, w: paste(x, w, 9), (glimpse, window))


def test_between_pixel_centres_the_gradient_of_the_weights_is_that_of_autograd() -> None:
    g = torch.Generator().manual_seed(7)
    inside = 12 * torch.rand(200, generator=g, dtype=torch.float64) - 2  # some just outside of 0..7
    far = torch.tensor([-1e6, -2.5, -1.5, 8.5, 9.5, 1e6], dtype=torch.float64)
    position = torch.cat([inside, far]).requires_grad_()
    plainly = (1 - (position[:, None] - torch.arange(8)).abs()).clamp_min(0)
    weights = torch.randn(206, 8, generator=g, dtype=torch.float64)
    torch.testing.assert_close(_triangle(position, 8), plainly)
    [wanted] = torch.autograd.grad((plainly * weights).sum(), position)
    [found] = torch.autograd.grad((_triangle(position, 8) * weights).sum(), position)
    torch.testing.assert_close(found, wanted)
    assert wanted.count_nonzero() > 100


def test_published_boxes_as_windows() -> None:
    """x first there, y first here; a size of zero can be pasted through."""
    window = window_of(torch.tensor([0.1, 0.2, 0.3, 0.4]))
    assert window.tolist() == torch.tensor([0.2, 0.1, 0.4, 0.3]).tolist()
    guarded = for_paste(torch.tensor([0.0, 0.0, 0.4, 0.3]))
    assert guarded.tolist() == torch.tensor([1e-9, 1e-9, 0.4, 0.3]).tolist()
    assert bool(paste(torch.ones(1, 1, 4, 4), guarded[None], 8).isfinite().all())

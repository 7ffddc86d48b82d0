"""Presence, windows and their priors (space.md sections 3, 8 and 12)."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.space.latents import (
    for_paste,
    kl_presence,
    relaxed_presence,
    split_gaussian,
    windows_of,
)
from apex_lab.scene import Noise
from tests.models.space.common import close, published


class Given(Noise):
    """Uniform numbers that a test chooses."""

    def __init__(self, uniform: Tensor) -> None:
        self._uniform = uniform

    def uniform(self, like: Tensor) -> Tensor:
        return self._uniform.to(like).expand_as(like)


def test_kl_of_presence_is_the_published_one() -> None:
    arrays = published()
    for prior, expected in zip(arrays["klb_priors"], arrays["klb_out"], strict=True):
        close(kl_presence(arrays["klb_logits"], prior), expected)


def test_kl_of_presence_is_zero_for_equal_distributions_and_finite_at_the_limits() -> None:
    logit = torch.tensor([-3.0, 0.0, 2.0])
    close(1 + kl_presence(logit, torch.sigmoid(logit)), torch.ones(3), 1e-6)
    assert kl_presence(torch.tensor([-8.8, 8.8]), torch.tensor(0.0)).isfinite().all()


def test_relaxed_presence_is_the_published_sample() -> None:
    arrays = published()
    z = relaxed_presence(arrays["relax_logits"], arrays["relax_tau"], Given(arrays["relax_uniform"]))
    torch.testing.assert_close(z, arrays["relax_sample"], atol=1e-4, rtol=0)


@pytest.mark.parametrize("u", [0.0, 1.0])
def test_relaxed_presence_survives_the_ends_of_the_uniform_distribution(u: float) -> None:
    logit = torch.zeros(3, requires_grad=True)
    z = relaxed_presence(logit, torch.tensor(0.5), Given(torch.tensor(u)))
    z.sum().backward()
    assert z.isfinite().all()
    assert logit.grad is not None
    assert logit.grad.isfinite().all()


def test_share_of_samples_above_one_half_is_the_probability() -> None:
    logit = torch.full((20000,), 1.0)
    torch.manual_seed(0)
    share = (relaxed_presence(logit, torch.tensor(2.5), Noise()) > 0.5).float().mean().item()
    assert share == pytest.approx(1 / (1 + math.exp(-1)), abs=0.01)


def test_windows_come_y_first_and_cells_row_major() -> None:
    scale, shift = torch.zeros(1, 16, 2), torch.zeros(1, 16, 2)
    scale[..., 0], shift[..., 0] = 1.0, 100.0  # x: wide, and a full cell to the right
    s_y, s_x, t_y, t_x = windows_of(scale, shift)[0, 6].unbind()  # row 1, column 2 of 4
    assert s_y.item() == pytest.approx(0.5)
    assert s_x.item() == pytest.approx(1 / (1 + math.exp(-1)))
    assert t_y.item() == pytest.approx(2 / 4 * 1.5 - 1)
    assert t_x.item() == pytest.approx(2 / 4 * 3.5 - 1)


def test_a_border_cells_centre_leaves_the_image_by_half_a_cell_at_most() -> None:
    centres = windows_of(torch.zeros(1, 64, 2), torch.full((1, 64, 2), 100.0))[..., 2:]
    assert centres.max().item() == pytest.approx(1 + 1 / 8)


def test_gaussians_split_mean_first() -> None:
    q = split_gaussian(torch.tensor([[1.0, 2.0, 0.0, -100.0]]), floor=1e-4)
    assert q.mean.tolist() == [[1.0, 2.0]]
    assert q.std[0].tolist() == pytest.approx([math.log(2) + 1e-4, 1e-4])


def test_pastes_divide_by_sizes_with_a_guard() -> None:
    assert for_paste(torch.zeros(1, 4)).tolist() == [[pytest.approx(1e-9), pytest.approx(1e-9), 0.0, 0.0]]

"""Latents of the foreground cells: presence, windows and their priors (space.md sections 3 and 8)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn.distributions import LOG_GUARD, Gaussian, kl_bernoulli
from apex_lab.nn.grid import cells
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import for_paste as for_paste
from apex_lab.scene import Noise

BOUND = 8.8
"""Largest presence logit, so q(pres) is within [1.5e-4, 0.99985]."""


class Cells(NamedTuple):
    """Posterior samples of n images with N = G^2 cells each, row-major.

    presence_prob (n, N): q(pres) in (0, 1); presence (n, N): z_pres, soft; depth (n, N): smaller is nearer;
    windows (n, N, 4): (s_y, s_x, t_y, t_x); what (n, N, Z).
    """

    presence_prob: Tensor
    presence: Tensor
    depth: Tensor
    windows: Tensor
    what: Tensor


def split_gaussian(raw: Float[Tensor, "... two_D"], floor: float = 0.0) -> Gaussian:
    """Mean first, raw standard deviation second: std = softplus(raw) + floor. Single precision under autocast too."""
    mean, spread = full(raw).chunk(2, dim=-1)
    return Gaussian(mean, F.softplus(spread) + floor)


def relaxed_presence(logit: Float[Tensor, "..."], temperature: Float[Tensor, ""], noise: Noise) -> Float[Tensor, "..."]:
    """Relaxed Bernoulli sample sigmoid((logit + log u - log(1 - u)) / temperature), in training and evaluation.

    From the logit itself, as published, where `apex_lab.nn.distributions.relaxed_logit` starts from a probability.
    """
    tiny = torch.finfo(logit.dtype).eps
    u = noise.uniform(logit).clamp(tiny, 1 - tiny)
    return torch.sigmoid((logit + u.log() - (-u).log1p()) / temperature)


def kl_presence(logit: Float[Tensor, "..."], prior: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """KL(Bernoulli(sigmoid(logit)) || Bernoulli(prior)), elementwise; nats.

    Priors down to 1e-10 are used, where 1 - p rounds to 1, so probabilities are guarded by `LOG_GUARD` and not clamped.
    """
    return kl_bernoulli(torch.sigmoid(logit), prior, added=LOG_GUARD)


def windows_of(scale: Float[Tensor, "n N 2"], shift: Float[Tensor, "n N 2"]) -> Float[Tensor, "n N 4"]:
    """Samples of z_scale and z_shift, x component first as published -> windows (s_y, s_x, t_y, t_x).

    The centre lies within one cell width of its cell's centre: t = 2 / G (c + 1/2 + tanh(shift)) - 1.
    """
    grid = math.isqrt(scale.shape[1])
    cell = cells(grid, scale).flip(-1)
    centre = 2 / grid * (cell + 0.5 + torch.tanh(shift.flip(-1))) - 1
    return torch.cat([torch.sigmoid(scale.flip(-1)), centre], dim=-1)

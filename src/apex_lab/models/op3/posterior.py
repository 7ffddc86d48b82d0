"""Diagonal Gaussians given by a mean and a raw scale whose softplus is the *variance* (op3.md sections 2 and 3.3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

LARGEST_RAW = 80.0
FLOOR = 1e-5
UNIT_RAW = math.log(math.e - 1)
"""Raw scale of a variance of 1 (and the floor)."""


def variance_of(raw: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Raw scale -> variance."""
    return F.softplus(raw.clamp_max(LARGEST_RAW)) + FLOOR


class RawGaussian(NamedTuple):
    """A diagonal Gaussian: mean (lambda 1) and raw scale (lambda 2), both (..., S)."""

    mean: Tensor
    raw: Tensor

    def sample(self, eps: Float[Tensor, "... S"]) -> Float[Tensor, "... S"]:
        """Reparameterised sample; `eps` is standard normal."""
        return self.mean + variance_of(self.raw).sqrt() * eps


def kl(posterior: RawGaussian, prior: RawGaussian) -> Float[Tensor, "..."]:
    """KL(posterior || prior), summed over the last dimension; nats."""
    variance, prior_variance = variance_of(posterior.raw), variance_of(prior.raw)
    ratio = variance / prior_variance
    shift = (posterior.mean - prior.mean).square() / prior_variance
    return 0.5 * (ratio + shift - 1 - ratio.log()).sum(-1)


def parameter_gradients(
    posterior: RawGaussian,
    prior: RawGaussian,
    eps: Float[Tensor, "... S"],
    sample_gradient: Float[Tensor, "... S"],
    beta: float,
) -> tuple[Float[Tensor, "... S"], Float[Tensor, "... S"]]:
    """Gradients of NLL + beta KL with respect to mean and raw scale.

    Args:
        posterior, prior: of the slots.
        eps: the noise of the sample that was decoded.
        sample_gradient: of the NLL with respect to that sample.
        beta: weight of the KL.
    """
    variance, prior_variance = variance_of(posterior.raw), variance_of(prior.raw)
    slope = posterior.raw.sigmoid() * (posterior.raw <= LARGEST_RAW)
    to_mean = sample_gradient + beta * (posterior.mean - prior.mean) / prior_variance
    to_variance = sample_gradient * eps / (2 * variance.sqrt()) + beta * 0.5 * (1 / prior_variance - 1 / variance)
    return to_mean, to_variance * slope

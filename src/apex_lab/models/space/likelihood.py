"""Likelihood of an image: a mixture of the foreground and the K background components (space.md section 6)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

GUARD = 1e-5
"""Added to a mask before its logarithm."""


def log_normal(x: Tensor, mean: Tensor, sigma: float) -> Tensor:
    """log N(x; mean, sigma^2), elementwise; nats."""
    return -0.5 * ((x - mean) / sigma).square() - (math.log(sigma) + 0.5 * math.log(2 * math.pi))


def log_likelihood(
    images: Float[Tensor, "n 3 H W"],
    alpha: Float[Tensor, "n H W"],
    foreground: Float[Tensor, "n 3 H W"],
    masks: Float[Tensor, "n K H W"],
    components: Float[Tensor, "n K 3 H W"],
    sigma_fg: float,
    sigma_bg: float,
) -> Float[Tensor, " n"]:
    """log p(x | z) of each image in nats, mixed for each colour channel by itself.

    Args:
        images: RGB in [0, 1].
        alpha: mixing weight of the foreground, in [0, 1].
        foreground: mu_fg, already multiplied by the masks.
        masks: pi of the background components, sum to 1.
        components: their means mu_k.
        sigma_fg, sigma_bg: standard deviations in units of RGB in [0, 1].
    """
    by_component = log_normal(images[:, None], components, sigma_bg) + (masks + GUARD).log()[:, :, None]
    by_background = torch.logsumexp(by_component, dim=1) + (1 - alpha + GUARD).log()[:, None]
    by_foreground = log_normal(images, foreground, sigma_fg) + (alpha + GUARD).log()[:, None]
    return torch.logaddexp(by_foreground, by_background).flatten(1).sum(1)

"""Latents: Gaussians, relaxed Bernoullis and their KL divergences (scalor.md sections 11 and 12)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn import distributions
from apex_lab.nn.distributions import LOG_GUARD, Gaussian, kl_bernoulli
from apex_lab.nn.precision import full
from apex_lab.scene import Noise

LOGIT_BOUND = 8.8
"""Bound of the presence logits: probabilities stay within [1.5e-4, 0.99985]."""

UNIT = 1.1920929e-07
"""How far uniform numbers and probabilities are kept from 0 and 1: float32's spacing at 1."""

GUARD = 1e-15
"""Added to denominators, and how far masks stay from 0 and 1."""

TINY_STD = 1e-12
"""Floor of standard deviations; the original has none, and softplus underflows to zero in float32 below -104."""


def full_precision(like: Tensor) -> torch.autocast:
    """No autocast: masks, sampling grids and guards of 1e-15 need float32 (scalor.md section 16, item 9)."""
    return torch.autocast(device_type=like.device.type, enabled=False)


def gaussian_of(raw: Float[Tensor, "... two_D"], offset: float = 0.0) -> Gaussian:
    """Means, then raw standard deviations -> a Gaussian with std = softplus(raw + offset), in float32."""
    mean, spread = full(raw).chunk(2, dim=-1)
    return Gaussian(mean, F.softplus(spread + offset).clamp_min(TINY_STD))


def bounded_logit(raw: Float[Tensor, "..."], offset: float = 0.0) -> Float[Tensor, "..."]:
    """Presence logit in (-8.8, 8.8), in float32."""
    return LOGIT_BOUND * torch.tanh(full(raw) + offset)


def relaxed_logit(
    logit: Float[Tensor, "..."], temperature: Float[Tensor, ""], uniform: Float[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Sample of the relaxed Bernoulli before its logistic function, from uniform numbers."""
    return distributions.relaxed_logit(torch.sigmoid(logit), temperature, uniform, UNIT)


def kl_presence(logit: Float[Tensor, "..."], prior: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """KL(Bernoulli(sigmoid(logit)) || Bernoulli(prior)), elementwise; nats. 1e-15 inside every logarithm."""
    return kl_bernoulli(torch.sigmoid(logit), prior, added=LOG_GUARD)


def kl_standard(q: Gaussian) -> Float[Tensor, "..."]:
    """KL(q || N(0, 1)), summed over the last dimension; nats.

    `kl_gaussian` squares before it takes the logarithm, which rounds otherwise: trained runs would not repeat with it.
    """
    return 0.5 * (q.mean.square() + q.std.square() - 1 - 2 * q.std.log()).sum(-1)


class Sampler:
    """Draws latents.

    Args:
        noise: random numbers; None takes means, and presence = [probability > 0.5].
        temperature: of the relaxed Bernoulli.
    """

    def __init__(self, noise: Noise | None, temperature: Float[Tensor, ""]) -> None:
        self._noise, self._temperature = noise, temperature

    def gaussian(self, q: Gaussian) -> Float[Tensor, "..."]:
        """Reparameterised sample."""
        return q.sample(self._noise)

    def presence(self, logit: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """z_pres in [0, 1]."""
        if self._noise is None:
            return (logit > 0).to(logit.dtype)
        return torch.sigmoid(relaxed_logit(logit, self._temperature, self._noise.uniform(logit)))

"""Gaussian and Bernoulli latents: reparameterised samples and closed-form KL divergences."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn.precision import full
from apex_lab.scene import Noise


class Gaussian(NamedTuple):
    """A diagonal Gaussian: mean and standard deviation, both (..., D)."""

    mean: Tensor
    std: Tensor

    def sample(self, noise: Noise | None) -> Tensor:
        """Reparameterised sample; without noise the mean."""
        return self.mean if noise is None else self.mean + self.std * noise.normal(self.mean)


def gaussian_from(raw: Float[Tensor, "... two_D"], min_std: float = 1e-3, max_std: float = 5.0) -> Gaussian:
    """Splits a head's output into a mean and a standard deviation, softplus-bounded to [min_std, max_std]."""
    mean, spread = raw.chunk(2, dim=-1)
    return Gaussian(mean, (F.softplus(spread) + min_std).clamp_max(max_std))


def standard_normal(like: Tensor) -> Gaussian:
    """N(0, 1) in the shape of `like`."""
    return Gaussian(torch.zeros_like(like), torch.ones_like(like))


def kl_gaussian(a: Gaussian, b: Gaussian) -> Float[Tensor, "..."]:
    """KL(a || b), summed over the last dimension; nats.

    The inclusive KL(p || q) of the paper is `kl_gaussian(p, q)`, the exclusive one `kl_gaussian(q, p)`.
    """
    ratio = (a.std / b.std).square()
    shift = ((a.mean - b.mean) / b.std).square()
    return 0.5 * (ratio + shift - 1 - ratio.log()).sum(-1)


LOG_GUARD = 1e-15
"""What SCALOR, SPACE and G-SWM add inside every logarithm of the KL of a presence."""


def kl_bernoulli(
    q: Float[Tensor, "..."], p: Float[Tensor, "..."], tiny: float = 1e-6, added: float | None = None
) -> Float[Tensor, "..."]:
    """KL(Bernoulli(q) || Bernoulli(p)) of probabilities, elementwise; nats.

    Args:
        q, p: probabilities; `p` may be one number for all.
        tiny: they are kept this far from 0 and 1.
        added: in place of `tiny`, they stay as they are, and this is added inside every logarithm: for priors such as
            1e-10, where 1 - p rounds to 1.
    """
    q, p = full(q), full(p)  # in half a precision 1 - tiny is 1, and its logarithm no number
    if added is None:
        q, p = q.clamp(tiny, 1 - tiny), p.clamp(tiny, 1 - tiny)
        return q * (q.log() - p.log()) + (1 - q) * ((-q).log1p() - (-p).log1p())
    present = q * ((q + added).log() - (p + added).log())
    return present + (1 - q) * ((1 - q + added).log() - (1 - p + added).log())


def relaxed_logit(
    prob: Float[Tensor, "..."], temperature: Tensor, uniform: Float[Tensor, "..."], tiny: float
) -> Float[Tensor, "..."]:
    """Reparameterised sample of the binary concrete distribution before its logistic function, from uniform numbers.

    Probabilities and uniform numbers are kept `tiny` from 0 and 1. P(sample > 0) = prob.
    """
    return (torch.logit(full(prob), tiny) + torch.logit(full(uniform), tiny)) / temperature


def relaxed_bernoulli(
    prob: Float[Tensor, "..."], temperature: Tensor, noise: Noise, tiny: float = 1e-6
) -> Float[Tensor, "..."]:
    """Reparameterised sample of the binary Gumbel-softmax (concrete) distribution with P(z > 0.5) = prob."""
    return torch.sigmoid(relaxed_logit(prob, temperature, noise.uniform(prob), tiny))

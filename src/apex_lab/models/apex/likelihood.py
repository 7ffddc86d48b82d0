"""Image likelihoods: APEX's spatial Gaussian mixture (Eq. 1) and the single Gaussian of the `gaussian` ablation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

Sigma = Annotated[float, Field(gt=0, le=10)]


def log_normal(x: Tensor, mean: Tensor, sigma: float) -> Tensor:
    """log N(x; mean, sigma^2), elementwise; nats."""
    return -0.5 * ((x - mean) / sigma).square() - math.log(sigma) - 0.5 * math.log(2 * math.pi)


class Likelihood(ABC):
    """log p(x | masks, means), summed over pixels and channels."""

    @abstractmethod
    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N 3 H W"],
    ) -> Float[Tensor, "N"]:
        """Log-likelihood of each image in nats.

        Args:
            image: RGB in [0, 1].
            log_objects: log masks of the objects; -inf for absent ones.
            objects: their means, RGB in [0, 1].
            log_background: log mask of the background; finite.
            background: its mean.
        """


class MixtureLikelihood(Likelihood):
    """Spatial Gaussian mixture with a standard deviation for the objects and one for the background (Eq. 1).

    Args:
        sigma_fg, sigma_bg: standard deviations in units of RGB in [0, 1]; the paper's values are 0.1 and 0.04.
        mixture_over: `channel` mixes each colour channel by itself (the GENESIS family), `pixel` mixes whole colours.
    """

    def __init__(
        self, sigma_fg: Sigma = 0.1, sigma_bg: Sigma = 0.04, mixture_over: Literal["channel", "pixel"] = "channel"
    ) -> None:
        self.sigma_fg, self.sigma_bg, self.mixture_over = sigma_fg, sigma_bg, mixture_over

    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N 3 H W"],
    ) -> Float[Tensor, "N"]:
        by_object = log_normal(image[:, None], objects, self.sigma_fg)
        by_background = log_normal(image, background, self.sigma_bg)
        if self.mixture_over == "pixel":
            by_object, by_background = by_object.sum(2, keepdim=True), by_background.sum(1, keepdim=True)
        foreground = torch.logsumexp(by_object + log_objects[:, :, None], dim=1)
        return torch.logaddexp(foreground, by_background + log_background[:, None]).flatten(1).sum(1)


class GaussianLikelihood(Likelihood):
    """One Gaussian around the blended picture, N(x; sum_k m_k mu_k, sigma^2): the `gaussian` ablation.

    Args:
        sigma: standard deviation in units of RGB in [0, 1]; the paper names none, default sigma_fg.
    """

    def __init__(self, sigma: Sigma = 0.1) -> None:
        self.sigma = sigma

    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N 3 H W"],
    ) -> Float[Tensor, "N"]:
        blend = (log_objects.exp()[:, :, None] * objects).sum(1) + log_background.exp()[:, None] * background
        return log_normal(image, blend, self.sigma).flatten(1).sum(1)

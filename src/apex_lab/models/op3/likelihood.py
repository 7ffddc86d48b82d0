"""The pixel likelihood and its gradients in closed form (op3.md sections 3.2 and 4)."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

CONSTANT = 248.05
"""(2 pi)^3 as in the published code, where a normalised Gaussian has (2 pi)^1.5; it only shifts the loss."""
FLOOR = 1e-12
SMALLEST_EXPONENT = -80.0
"""Densities below exp of this are far below `FLOOR`, and CPUs take ten times as long for numbers that underflow."""


class Mixture(NamedTuple):
    """The mixture at every pixel of B images.

    Attributes:
        masks: mixing weights, sum 1 over K, (B, K, H, W).
        by_slot: density of each slot, without its mask, (B, K, H, W).
        density: of the mixture, (B, H, W).
    """

    masks: Tensor
    by_slot: Tensor
    density: Tensor

    def nll(self) -> Float[Tensor, " B"]:
        """Negative log-likelihood of each image, summed over its pixels; nats."""
        return -(self.density + FLOOR).log().flatten(1).sum(1)


class ImageGradients(NamedTuple):
    """Gradients of the NLL in the space of images.

    Attributes:
        masks: with respect to the masks as free variables (after the softmax), (B, K, H, W).
        colours: (B, K, 3, H, W).
        logits: with respect to the mask logits (before the softmax), (B, K, H, W).
    """

    masks: Tensor
    colours: Tensor
    logits: Tensor


def mixture(
    image: Float[Tensor, "B 3 H W"],
    colours: Float[Tensor, "B K 3 H W"],
    logits: Float[Tensor, "B K H W"],
    sigma: float,
) -> Mixture:
    """The mixture of slots at every pixel.

    The exponent has a third of a Gaussian's, as published: the standard deviation of a channel is sqrt(3) sigma.

    Args:
        image: RGB in [0, 1].
        colours: of the slots; unbounded.
        logits: of the masks.
        sigma: in units of RGB in [0, 1].
    """
    error = (colours - image[:, None]).square().sum(2)
    by_slot = (error * (-1 / (6 * sigma**2))).clamp_min(SMALLEST_EXPONENT).exp() * (1 / (sigma**3 * CONSTANT))
    masks = logits.softmax(1)
    return Mixture(masks, by_slot, (masks * by_slot).sum(1))


def image_gradients(
    image: Float[Tensor, "B 3 H W"], colours: Float[Tensor, "B K 3 H W"], found: Mixture, sigma: float
) -> ImageGradients:
    """Gradients of the sum of the images' NLL; arguments as of `mixture`, and its result."""
    to_masks = -found.by_slot / (found.density + FLOOR)[:, None]
    weighted = found.masks * to_masks
    to_colours = weighted[:, :, None] * (image[:, None] - colours) * (1 / (3 * sigma**2))
    to_logits = weighted - found.masks * weighted.sum(1, keepdim=True)
    return ImageGradients(to_masks, to_colours, to_logits)

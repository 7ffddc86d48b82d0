"""The background component: its posterior, its prior over time, and its decoder."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.nn.blocks import BroadcastDecoder, conv_norm, mlp
from apex_lab.nn.distributions import Gaussian, gaussian_from, standard_normal
from apex_lab.nn.layout import for_convolutions

Count = Annotated[int, Field(gt=0)]

BRIGHTEST = math.log(2)
"""Largest shade, in logits: a grey of 0.5 becomes 0.67 at most."""


def shadowed(
    backdrop: Float[Tensor, "*batch 3 H W"], image: Float[Tensor, "*batch 3 H W"], darkest: float | Float[Tensor, ""]
) -> Float[Tensor, "*batch 3 H W"]:
    """The background with every pixel as dark as the image has it, down to `darkest` times its colour.

    Not in the paper. A cast shadow is the same colour, darker. Of all u b with u in [darkest, 1], the one nearest to x
    has u = <x, b> / <b, b>, clamped. There the likelihood is largest, so u passes no gradient on.
    """
    with torch.no_grad():
        u = (image * backdrop).sum(-3, keepdim=True) / backdrop.square().sum(-3, keepdim=True).clamp_min(1e-6)
        u = u.clamp_min(darkest).clamp_max_(1.0)
    return backdrop * u


class Background(nn.Module):
    """z_bg and its image.

    Args:
        image_size: side of the image in pixels.
        latent: length of z_bg.
        width: channels of encoder and decoder.
        bias_image: `none` is the paper's plain decoder. `learned` adds a full-resolution bias image to the decoder's
            logits: a parameter, initialised at the training set's per-pixel median, as one initialises an output bias
            at the mean of the data. A convolutional decoder needs thousands of steps to draw sharp static edges, and
            until then the foreground explains them.
        change: what z_bg may do to the image. `colour` is the paper's: anything. `shade` lets it darken or (less)
            brighten the bias image, all channels of a pixel alike in their logits, which needs a `learned` one. Over a
            table that has a hue that draws cast shadows, but few of the grey parts of a moving arm, which `colour`
            draws too, so that the foreground never explains them.
        shadow: how dark a cast shadow may make each pixel by itself, as a share of its colour; 1 is the paper's: none.
            A pixel is as likely lit as it is shadowed (see `seen`).

    Raises:
        ValueError: there is no bias image to shade.
    """

    def __init__(
        self,
        image_size: Count,
        latent: Count = 32,
        width: Count = 32,
        bias_image: Literal["none", "learned"] = "learned",
        change: Literal["colour", "shade"] = "colour",
        shadow: Annotated[float, Field(gt=0, le=1)] = 1.0,
    ) -> None:
        super().__init__()
        if change == "shade" and bias_image == "none":
            raise ValueError(
                "change = 'shade' needs a bias image to shade: set bias_image = 'learned' or change = 'colour'"
            )
        self.change, self.shadow = change, shadow
        layers: list[nn.Module] = [conv_norm(4, width, kernel=5, stride=4)]
        self.image_size = image_size
        side = image_size // 4
        while side > 4:
            layers.append(conv_norm(width, width, stride=2))
            side = (side + 1) // 2
        self.encoder = nn.Sequential(*layers, nn.Flatten(), mlp([width * side * side, 4 * latent, 2 * latent]))
        self.transition = mlp([latent, 4 * latent, 2 * latent])
        self.decoder = BroadcastDecoder(latent, image_size, width, 3 if change == "colour" else 1)
        self.bias_image = nn.Parameter(torch.zeros(3, image_size, image_size)) if bias_image == "learned" else None

    def initialise(self, median: Float[Tensor, "3 H W"]) -> None:
        """Starts the image at the training set's median, if there is a bias image."""
        if self.bias_image is None:
            return
        with torch.no_grad():
            self.bias_image.copy_(torch.logit(median, eps=0.02))
            last = self.decoder.head[0]
            assert isinstance(last, nn.Conv2d)
            assert last.bias is not None
            last.weight.mul_(0.1)
            last.bias.zero_()

    def posterior(self, mask: Float[Tensor, "N H W"], image: Float[Tensor, "N 3 H W"]) -> Gaussian:
        """q(z_bg | m_bg, x), the first factor of Eq. 14: a CNN on the background mask and the image."""
        return gaussian_from(self.encoder(for_convolutions(torch.cat([mask[:, None], image], dim=1))))

    def prior(self, z: Float[Tensor, "B T Z"], before: Float[Tensor, "B Z"] | None = None) -> Gaussian:
        """p(z_bg_t | z_bg_{t-1}) for every frame, the first factor of Eq. 4.

        Args:
            z: of the frames.
            before: of the frame before the first one; None where there is none, and the prior is N(0, 1).
        """
        first = standard_normal(z[:, :1]) if before is None else gaussian_from(self.transition(before[:, None]))
        later = gaussian_from(self.transition(z[:, :-1]))
        return Gaussian(*(torch.cat([a, b], dim=1) for a, b in zip(first, later, strict=True)))

    def cast(
        self,
        backdrop: Float[Tensor, "*batch 3 H W"],
        image: Float[Tensor, "*batch 3 H W"],
        depth: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, "*batch 3 H W"]:
        """The decoded background with the image's cast shadows on it, if it may have any.

        Args:
            backdrop: decoded.
            image: RGB in [0, 1].
            depth: in [0, 1], how far towards `shadow` they may go; None: all the way.
        """
        if self.shadow == 1:
            return backdrop
        darkest = self.shadow if depth is None else 1 - (1 - self.shadow) * depth
        return shadowed(backdrop, image, darkest)

    def seen(
        self,
        backdrop: Float[Tensor, "N 3 H W"],
        image: Float[Tensor, "N 3 H W"],
        depth: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, "N S 3 H W"]:
        """What each pixel of the background may look like: as decoded and, if there are shadows, as the image has it.

        Both, because shadows alone would let the decoded image become brighter at no cost.
        """
        return torch.stack([backdrop] if self.shadow == 1 else [backdrop, self.cast(backdrop, image, depth)], dim=1)

    def decode(self, z: Float[Tensor, "N Z"]) -> Float[Tensor, "N 3 H W"]:
        """z_bg -> RGB in [0, 1]."""
        logit = self.decoder(z)
        if self.change == "shade":
            logit = BRIGHTEST - F.softplus(-logit)  # no change at zero
        return torch.sigmoid(logit if self.bias_image is None else logit + self.bias_image)

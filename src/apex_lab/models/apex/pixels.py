"""What masks may see of the image itself. Not in the paper, whose masks are decoded from z_what alone (Eq. 7).

A code of some numbers cannot hold where each rim runs, so decoded masks are blobs. The likelihood knows better: it
gives a pixel that the background draws well to the background. Here features of each pixel shift the mask logits by how
well they agree with what the object's code asks for; the rest of the mask normalisation stays as it is.
"""

from __future__ import annotations

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.nn.blocks import group_norm
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.spatial_transformer import crop

Count = Annotated[int, Field(gt=0)]


class PixelEvidence(nn.Module):
    """Shifts of mask logits: the product of a pixel's features and a query made of z_what; zero when training starts.

    Args:
        what: length of z_what.
        features: of a pixel.
        width: channels of the convolution before.
    """

    def __init__(self, what: Count, features: Count, width: Count = 16) -> None:
        super().__init__()
        self.convs = nn.Sequential(
            nn.Conv2d(6, width, 3, padding=1), group_norm(width), nn.CELU(), nn.Conv2d(width, features, 1)
        )
        self.query = nn.Linear(what, features)
        nn.init.zeros_(self.query.weight)
        nn.init.zeros_(self.query.bias)

    def forward(
        self, image: Float[Tensor, "N 3 H W"], empty: Float[Tensor, "N 3 H W"]
    ) -> Float[Tensor, "N features H W"]:
        """Features of pixels.

        Args:
            image: RGB in [0, 1].
            empty: what it would show without objects, as far as that is known; the image itself where it is not.
        """
        return self.convs(for_convolutions(torch.cat([image - 0.5, image - empty], dim=1)))

    def shifts(
        self,
        features: Float[Tensor, "N features H W"],
        what: Float[Tensor, "N n Z"],
        window: Float[Tensor, "N n 4"],
        size: int,
    ) -> Float[Tensor, "N n size size"]:
        """What is added to each object's mask logits before they are squashed; windows get no gradient from it."""
        agreement = (self.query(what) @ features.flatten(2)).view(-1, 1, *features.shape[-2:])
        return crop(agreement, window.detach().reshape(-1, 1, 4), size).view(*what.shape[:2], size, size)

    def nothing(self) -> Float[Tensor, ""]:
        """Zero, on which all weights depend: they have gradients, of zero, where pixels do not count."""
        return sum((weight.flatten()[0] * 0 for weight in self.parameters()), start=self.query.weight.new_zeros(()))

"""Where glimpses and propagation crops are cut from: the feature map (APEX) or the image (`image_stn` ablation)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.nn.blocks import GlimpseEncoder
from apex_lab.nn.spatial_transformer import crop
from apex_lab.nn.splitting import joined, part_size

Size = Annotated[int, Field(ge=4, le=128)]
Count = Annotated[int, Field(gt=0)]


class Glimpses(nn.Module, ABC):
    """Cuts windows out of its source and encodes them, with one CNN for glimpses and one for propagation crops.

    Args:
        size: side of a crop in pixels of a feature map; crops of the image have twice as many.
        width: channels of the two CNNs.
        shortcut: whether a weighted sum of a crop's values adds to its code, and codes of glimpses go to z_what's head
            past the RNN too. Not in the paper: colours reach z_what within hundreds of steps.
    """

    pixels_per_size = 1

    def __init__(self, size: Size, width: Count, shortcut: bool = True) -> None:
        super().__init__()
        self.shortcut = shortcut
        self.size, self.width = size * self.pixels_per_size, width
        self.crop = crop  # an attribute, so that a benchmark can put another spatial transformer in its place

    def build(self, features: int, code: int) -> None:
        """Makes the CNNs; called once by the model, which knows F and the length of a code."""
        glimpse, propagation = self.channels(features)
        self.glimpse = GlimpseEncoder(glimpse, self.size, self.width, code, self.shortcut)
        self.propagation = GlimpseEncoder(propagation, self.size, self.width, code, self.shortcut)

    @abstractmethod
    def channels(self, features: int) -> tuple[int, int]:
        """Channels of the sources of glimpses and of propagation crops."""

    @abstractmethod
    def sources(
        self,
        video: Float[Tensor, "B T 3 H W"],
        features: Float[Tensor, "B T F h w"],
        before: Float[Tensor, "B 3 H W"] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Sources of glimpses and propagation crops, each (B, T, C, h, w).

        Args:
            video: RGB in [0, 1].
            features: of its frames.
            before: the frame before the first one; None where there is none.
        """

    def look(self, source: Float[Tensor, "B C h w"], window: Float[Tensor, "B K 4"]) -> Float[Tensor, "B K code"]:
        """Codes of the glimpses (z_what's evidence)."""
        return self._encode(self.glimpse, source, window)

    def follow(self, source: Float[Tensor, "B C h w"], window: Float[Tensor, "B K 4"]) -> Float[Tensor, "B K code"]:
        """Codes of the propagation crops, c_p."""
        return self._encode(self.propagation, source, window)

    def _encode(self, encoder: nn.Module, source: Tensor, window: Tensor) -> Tensor:
        windows = window.shape[1]
        largest = windows * self.size**2 * max(self.width, source.shape[1])
        size = part_size(len(source), largest, source)
        return joined(
            encoder(self.crop(images, places, self.size).flatten(0, 1)).unflatten(0, (-1, windows))
            for images, places in zip(source.split(size), window.split(size), strict=True)
        )


class FeatureGlimpses(Glimpses):
    """From the feature map e_t, as APEX does."""

    def channels(self, features: int) -> tuple[int, int]:
        """F for both."""
        return features, features

    def sources(
        self,
        video: Float[Tensor, "B T 3 H W"],
        features: Float[Tensor, "B T F h w"],
        before: Float[Tensor, "B 3 H W"] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The feature maps themselves."""
        return features, features


class ImageGlimpses(Glimpses):
    """From the image x_t; a propagation crop also sees the previous frame, since it infers motion."""

    pixels_per_size = 2

    def channels(self, features: int) -> tuple[int, int]:
        """RGB; RGB of two frames."""
        return 3, 6

    def sources(
        self,
        video: Float[Tensor, "B T 3 H W"],
        features: Float[Tensor, "B T F h w"],
        before: Float[Tensor, "B 3 H W"] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """x_t, and [x_t, x_{t-1}] (a video's first frame is its own predecessor)."""
        centred = video - 0.5
        first = centred[:, :1] if before is None else before[:, None] - 0.5
        return centred, torch.cat([centred, torch.cat([first, centred[:, :-1]], dim=1)], dim=2)

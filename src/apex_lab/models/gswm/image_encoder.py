"""Discovery's image encoder: the first three stages of a ResNet-18 without max-pooling (gswm.md section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.models.gswm.networks import norm
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.precision import full
from apex_lab.nn.splitting import joined, part_size

Count = Annotated[int, Field(gt=0)]
Norm = Literal["frame", "clip", "group"]

STRIDE = 8
"""Of the residual stages and the convolution before them."""


class FrameBatchNorm(nn.BatchNorm2d):
    """Batch normalisation with statistics of one frame of all videos, for many frames at once.

    The published model runs frame by frame, so in training its statistics are those of B images. Convolutions rather
    see many images, so only the norms take the frames apart.
    """

    def over(self, images: Float[Tensor, "N C h w"], frames: int) -> Float[Tensor, "N C h w"]:
        """Images of `frames` frames of every video, frames slowest."""
        if frames == 1 or not self.training:
            return self(images)
        return torch.cat([self(frame) for frame in images.chunk(frames)])


class Residual(nn.Module):
    """Two 3 x 3 convolutions and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, kind: Norm) -> None:
        super().__init__()
        self.conv_1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm_1 = _norm(outputs, kind)
        self.conv_2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norm_2 = _norm(outputs, kind)
        self.shortcut, self.norm_shortcut = None, None
        if stride > 1 or inputs != outputs:
            self.shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.norm_shortcut = _norm(outputs, kind)

    def forward(self, x: Float[Tensor, "N C h w"], frames: int) -> Float[Tensor, "N c h2 w2"]:
        shortcut = x
        if self.shortcut is not None and self.norm_shortcut is not None:
            shortcut = _normed(self.norm_shortcut, self.shortcut(x), frames)
        x = F.relu(_normed(self.norm_1, self.conv_1(x), frames), inplace=True)
        x = _normed(self.norm_2, self.conv_2(x), frames)
        return F.relu(x + shortcut, inplace=True)


def _norm(channels: int, kind: Norm) -> nn.Module:
    return norm(channels) if kind == "group" else FrameBatchNorm(channels)


def _normed(layer: nn.Module, x: Tensor, frames: int) -> Tensor:
    return layer.over(x, frames) if isinstance(layer, FrameBatchNorm) else layer(x)


class ImageEncoder(nn.Module):
    """Frames and what the background leaves of them -> features of the cells of discovery.

    Args:
        image_size: H = W in pixels.
        grid: G; `image_size` is a multiple of 8 G.
        widths: channels of the first convolution and of the stages (the first of both is the same).
        blocks: residual blocks of each stage.
        outputs: features of a cell.
        norm: how activations are normalised. `frame`: batch normalisation over the same frame of all videos, as
            published; `clip`: over all frames of all videos; `group`: GroupNorm, the same for every batch and rank.
    """

    def __init__(
        self,
        image_size: Count,
        grid: Count = 4,
        widths: Sequence[Count] = (64, 128, 256),
        blocks: Sequence[Count] = (2, 2, 2),
        outputs: Count = 128,
        norm: Norm = "frame",
    ) -> None:
        super().__init__()
        if image_size % (STRIDE * grid):
            raise ValueError(f"image_encoder.image_size={image_size} must be a multiple of {STRIDE} x grid={grid}")
        if len(widths) != 3 or len(blocks) != 3:
            raise ValueError(f"image_encoder has 3 stages: widths={list(widths)} and blocks={list(blocks)} must say so")
        self.grid, self.outputs, self.kind = grid, outputs, norm
        self.conv = nn.Conv2d(6, widths[0], 7, 2, 3, bias=False)
        self.norm = _norm(widths[0], norm)
        stages, inputs = [], widths[0]
        for stage, (width, count) in enumerate(zip(widths, blocks, strict=True)):
            for block in range(count):
                stages.append(Residual(inputs, width, 2 if stage > 0 and block == 0 else 1, norm))
                inputs = width
        self.stages = nn.ModuleList(stages)
        self.head = nn.Conv2d(inputs, outputs, 3, image_size // (STRIDE * grid), 1)
        self._largest = widths[0] * (image_size // 2) ** 2
        for conv in (m for m in self.stages.modules() if isinstance(m, nn.Conv2d)):
            nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Float[Tensor, "B T 6 H W"]) -> Float[Tensor, "B T features G G"]:
        b, t = images.shape[:2]
        together = t
        if self.kind != "clip" or not self.training:  # the frames do not depend on each other
            together = part_size(t, b * self._largest, images)
        parts = [self._of(part) for part in images.transpose(0, 1).split(together)]
        return joined(parts).transpose(0, 1)

    def _of(self, images: Float[Tensor, "T B 6 H W"]) -> Float[Tensor, "T B features G G"]:
        frames = 1 if self.kind == "clip" else len(images)
        x = self.conv(for_convolutions(images.flatten(0, 1)))
        x = F.relu(_normed(self.norm, x, frames), inplace=True)
        for stage in self.stages:
            x = stage(x, frames)
        return full(self.head(x)).unflatten(0, images.shape[:2])

"""Image encoder and the ConvLSTM that runs over its feature maps (scalor.md section 3)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import halved, halvings, same
from apex_lab.nn.conv_lstm import ConvLSTM
from apex_lab.nn.layout import for_convolutions

FEATURES = 64
"""Channels of e_t."""

LSTMState = list[tuple[Tensor, Tensor]]
"""(hidden, cell) of every layer, each (B, 64, G, G)."""


class ImageEncoder(nn.Module):
    """Image -> feature map on the grid of discovery cells.

    Published for images of 64 and 128 px and grids of 4 and 8; other ratios follow the same rule: three stages of 16,
    32 and 64 channels, then strided convolutions down to the grid, the last of them with 128 channels at 128 px.

    Args:
        image_size: H = W in pixels.
        grid: G.
    """

    def __init__(self, image_size: int, grid: int) -> None:
        super().__init__()
        levels = halvings(image_size, grid)
        layers: list[nn.Module] = []
        channels = 3
        for width in (16, 32, 64)[:levels]:
            layers += [*halved(channels, width), *same(width, width)]
            channels = width
        for level in range(3, levels):
            last = level == levels - 1
            width = 128 if last and image_size >= 128 else 64
            layers += halved(channels, width)
            if not last:
                layers += same(width, width)
            channels = width
        layers += same(channels, FEATURES, kernel=1, groups=16)
        self.stack = nn.Sequential(*layers)
        self.lateral = nn.Sequential(*same(FEATURES, FEATURES), *same(FEATURES, FEATURES))
        self.fuse = nn.Sequential(*same(2 * FEATURES, FEATURES))

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 64 G G"]:
        u = self.stack(for_convolutions(images))
        return self.fuse(torch.cat([u, self.lateral(u)], dim=1))


class PeepholeConvLSTM(ConvLSTM):
    """One ConvLSTM layer with peepholes; the output gate looks at the cell before its update, as published.

    Args:
        channels: in and out.
        grid: G; the peephole weights are per pixel.
    """

    def __init__(self, channels: int, grid: int) -> None:
        super().__init__(channels, forget=None)
        self.peephole = nn.Parameter(torch.zeros(3, channels, grid, grid))  # W_i, W_f, W_o

    def step(
        self, driven: Float[Tensor, "B C4 G G"], hidden: Float[Tensor, "B C G G"], cell: Float[Tensor, "B C G G"]
    ) -> tuple[Float[Tensor, "B C G G"], Float[Tensor, "B C G G"]]:
        gates, candidate = (driven + self.from_hidden(hidden)).split([3 * cell.shape[1], cell.shape[1]], dim=1)
        peeped = gates.unflatten(1, (3, -1)) + cell[:, None] * self.peephole
        into, forget, out = torch.sigmoid(peeped).unbind(1)
        cell = forget * cell + into * torch.tanh(candidate)
        return out * torch.tanh(cell), cell


class VideoEncoder(nn.Module):
    """Video -> e_t of every frame, which knows the frames before it too.

    Args:
        image_size: H = W in pixels.
        grid: G.
        layers: of the ConvLSTM.
    """

    def __init__(self, image_size: int, grid: int, layers: int = 2) -> None:
        super().__init__()
        self.image = ImageEncoder(image_size, grid)
        self.memory = nn.ModuleList(PeepholeConvLSTM(FEATURES, grid) for _ in range(layers))

    def forward(
        self, video: Float[Tensor, "B T 3 H W"], state: LSTMState | None
    ) -> tuple[Float[Tensor, "B T 64 G G"], LSTMState]:
        """e_t, and the ConvLSTM's state after the last frame."""
        features = self.image(video.flatten(0, 1)).unflatten(0, video.shape[:2])
        after = []
        for i, layer in enumerate(self.memory):
            features, kept = layer(features, None if state is None else state[i])
            after.append(kept)
        return features, after

"""Deep layer aggregation (Yu et al. 2018) with the iterative up-sampling of Zhou et al. 2019, GroupNorm throughout."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.blocks import conv_norm, group_norm
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.splitting import joined, part_size


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions around a skip connection that the caller provides."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = conv_norm(inputs, outputs, stride=stride)
        self.second = nn.Sequential(nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), group_norm(outputs))

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return torch.relu(self.second(self.first(x)) + skip)


class AggregationTree(nn.Module):
    """Hierarchical deep aggregation: a binary tree of residual blocks whose root joins all of its leaves.

    Args:
        depth: 1 joins two blocks; depth n joins two trees of depth n - 1.
        inputs, outputs: channels.
        stride: of the first block.
        passed: channels of earlier results that the root joins too.
    """

    def __init__(self, depth: int, inputs: int, outputs: int, stride: int = 1, passed: int = 0) -> None:
        super().__init__()
        self.depth = depth
        if depth == 1:
            self.shrink = nn.MaxPool2d(stride) if stride > 1 else nn.Identity()
            project = nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), group_norm(outputs))
            self.project = project if inputs != outputs else nn.Identity()
            self.left: nn.Module = ResidualBlock(inputs, outputs, stride)
            self.right: nn.Module = ResidualBlock(outputs, outputs)
            self.root = conv_norm(2 * outputs + passed, outputs, kernel=1)
        else:
            self.left = AggregationTree(depth - 1, inputs, outputs, stride)
            self.right = AggregationTree(depth - 1, outputs, outputs, passed=passed + outputs)

    def forward(self, x: Tensor, passed: Sequence[Tensor] = ()) -> Tensor:
        if self.depth > 1:
            left = self.left(x)
            return self.right(left, (*passed, left))
        left = self.left(x, self.project(self.shrink(x)))
        right = self.right(left, left)
        return self.root(torch.cat([right, left, *passed], dim=1))


class UpSample(nn.Module):
    """Doubles a feature map by a depthwise transposed convolution that starts as bilinear interpolation."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.ConvTranspose2d(channels, channels, 4, 2, padding=1, groups=channels, bias=False)
        ramp = torch.tensor([0.25, 0.75, 0.75, 0.25])
        with torch.no_grad():
            self.conv.weight.copy_(torch.outer(ramp, ramp).expand_as(self.conv.weight))

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class Merge(nn.Module):
    """One node of iterative deep aggregation: projects and doubles the coarse map, adds the fine one, mixes."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.project = conv_norm(coarse, fine)
        self.up = UpSample(fine)
        self.mix = conv_norm(fine, fine)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        return self.mix(self.up(self.project(coarse)) + fine)


class DLA(nn.Module):
    """Image -> feature map of a quarter of its side.

    Six levels at strides 1, 2, 4, 8, 16, 32: two plain ones, then aggregation trees; iterative deep aggregation brings
    strides 8, 16, 32 back to 4.

    Args:
        features: F, channels of the result.
        widths: channels of the six levels; DLA-34 has (16, 32, 64, 128, 256, 512).
        depths: depths of the four trees; DLA-34 has (1, 2, 2, 1).
    """

    def __init__(self, features: int, widths: Sequence[int], depths: Sequence[int]) -> None:
        super().__init__()
        if len(widths) != 6 or len(depths) != 4:
            raise ValueError(f"DLA takes 6 widths and 4 depths, got {list(widths)} and {list(depths)}")
        self.widest = widths[0]
        self.stem = nn.Sequential(
            conv_norm(3, widths[0], kernel=7),
            conv_norm(widths[0], widths[0]),
            conv_norm(widths[0], widths[1], stride=2),
        )
        self.trees = nn.ModuleList(
            AggregationTree(depth, widths[i + 1], widths[i + 2], stride=2) for i, depth in enumerate(depths)
        )
        strides = list(widths[2:])
        self.stages = nn.ModuleList()
        for start in range(len(strides) - 2, -1, -1):
            stage = nn.ModuleList()
            for i in range(start, len(strides) - 1):
                stage.append(Merge(strides[i + 1], strides[start]))
                strides[i + 1] = strides[start]
            self.stages.append(stage)
        self.head = nn.Conv2d(strides[-1], features, 1)

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N F H/4 W/4"]:
        # At full resolution images are many and weights few: in parts.
        size = part_size(len(images), self.widest * images.shape[-2:].numel(), images)
        x = joined(self.stem(for_convolutions(part)) for part in images.split(size))
        maps = []
        for tree in self.trees:
            x = tree(x)
            maps.append(x)
        for start, stage in zip(range(len(maps) - 2, -1, -1), self.stages, strict=True):
            fine = maps[start]
            assert isinstance(stage, nn.ModuleList)
            for i, merge in enumerate(stage, start=start):
                fine = maps[i + 1] = merge(maps[i + 1], fine)
        return self.head(maps[-1])

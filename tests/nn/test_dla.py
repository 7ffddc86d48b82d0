"""Deep layer aggregation against a plain function of its weights, written from the papers' figures."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.nn.dla import DLA, AggregationTree

Weights = dict[str, Tensor]


def norm(x: Tensor, w: Weights, name: str) -> Tensor:
    """GroupNorm by its definition."""
    channels = x.shape[1]
    groups = math.gcd(channels, max(1, channels // 8))
    g = x.reshape(len(x), groups, -1)
    g = (g - g.mean(-1, keepdim=True)) / (g.var(-1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    return g.reshape(x.shape) * w[f"{name}.weight"][:, None, None] + w[f"{name}.bias"][:, None, None]


def conv(x: Tensor, w: Weights, name: str, stride: int = 1) -> Tensor:
    """Convolution, norm, ReLU."""
    kernel = w[f"{name}.0.weight"]
    return norm(F.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2), w, f"{name}.1").relu()


def block(x: Tensor, skip: Tensor, w: Weights, name: str, stride: int = 1) -> Tensor:
    inner = conv(x, w, f"{name}.first", stride)
    return (norm(F.conv2d(inner, w[f"{name}.second.0.weight"], padding=1), w, f"{name}.second.1") + skip).relu()


def tree(x: Tensor, w: Weights, name: str, depth: int, stride: int = 1, passed: tuple[Tensor, ...] = ()) -> Tensor:
    """Two blocks and a root; at depth 2 the second tree's root also joins the first tree's result."""
    if depth == 2:
        first = tree(x, w, f"{name}.left", 1, stride)
        return tree(first, w, f"{name}.right", 1, 1, (*passed, first))
    skip = F.max_pool2d(x, stride) if stride > 1 else x
    if f"{name}.project.0.weight" in w:
        skip = norm(F.conv2d(skip, w[f"{name}.project.0.weight"]), w, f"{name}.project.1")
    left = block(x, skip, w, f"{name}.left", stride)
    right = block(left, left, w, f"{name}.right")
    return conv(torch.cat([right, left, *passed], 1), w, f"{name}.root")


def up(coarse: Tensor, fine: Tensor, w: Weights, name: str) -> Tensor:
    """A node of iterative aggregation: project, double, add, mix."""
    projected = conv(coarse, w, f"{name}.project")
    kernel = w[f"{name}.up.conv.weight"]
    doubled = F.conv_transpose2d(projected, kernel, stride=2, padding=1, groups=len(kernel))
    return conv(doubled + fine, w, f"{name}.mix")


def test_dla_against_its_figure() -> None:
    """Strides 4, 8, 16, 32 become three maps of strides 4, 8, 16, then two, then one."""
    torch.manual_seed(0)
    net = DLA(5, (4, 6, 8, 10, 12, 14), (1, 2, 2, 1)).double()
    for p in net.parameters():  # so that norms and up-sampling do not sit at their start values
        p.data += 0.1 * torch.randn_like(p)
    w = dict(net.named_parameters())
    x = torch.randn(2, 3, 64, 64, dtype=torch.float64)
    y = conv(conv(conv(x, w, "stem.0"), w, "stem.1"), w, "stem.2", 2)
    s4 = tree(y, w, "trees.0", 1, 2)
    s8 = tree(s4, w, "trees.1", 2, 2)
    s16 = tree(s8, w, "trees.2", 2, 2)
    s32 = tree(s16, w, "trees.3", 1, 2)
    assert [len(x[0, 0]) for x in (s4, s8, s16, s32)] == [16, 8, 4, 2]
    a16 = up(s32, s16, w, "stages.0.0")
    b8 = up(s16, s8, w, "stages.1.0")
    b8 = up(a16, b8, w, "stages.1.1")
    c4 = up(s8, s4, w, "stages.2.0")
    c4 = up(up(s16, s8, w, "stages.1.0"), c4, w, "stages.2.1")
    c4 = up(b8, c4, w, "stages.2.2")
    want = F.conv2d(c4, w["head.weight"], w["head.bias"])
    torch.testing.assert_close(net(x), want)


def test_a_tree_of_depth_three_hands_every_result_to_the_last_root() -> None:
    net = AggregationTree(3, 4, 6, 2)
    assert net.right.right.root[0].in_channels == 2 * 6 + 2 * 6  # two blocks, and the two trees before
    net(torch.randn(1, 4, 8, 8)).sum().backward()
    assert all(p.grad is not None for p in net.parameters())

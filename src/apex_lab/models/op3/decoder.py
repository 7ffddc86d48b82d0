"""Spatial broadcast decoder (op3.md section 3.1), with its gradient with respect to the slot written out."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.precision import full
from apex_lab.nn.tiled_conv import TiledConv, TiledWeights

WIDTH, KERNEL, LAYERS = 32, 5, 5


class Decoded(NamedTuple):
    """What the decoder makes of N slots.

    Attributes:
        colours: unbounded, (N, 3, H, W).
        logits: of the masks, (N, H, W).
        hidden: outputs of all layers but the last, after the ELU, each (N, 32, H, W).
    """

    colours: Tensor
    logits: Tensor
    hidden: tuple[Tensor, ...]


class Decoder(nn.Module):
    """Slot -> colours and mask logit: five 5 x 5 convolutions over the tiled slot and two coordinate maps.

    Args:
        slot: length of the full slot state.
        size: H = W in pixels.
    """

    def __init__(self, slot: int, size: int) -> None:
        super().__init__()
        self.first = TiledConv(slot, WIDTH, KERNEL, size)
        widths = [WIDTH] * (LAYERS - 1) + [4]
        self.others = nn.ModuleList(nn.Conv2d(WIDTH, width, KERNEL, padding=KERNEL // 2) for width in widths[1:])
        for conv in (self.first, *self.others):
            assert isinstance(conv, nn.Conv2d)
            start_conv(conv)

    def prepare(self) -> TiledWeights:
        """What is the same for all slots and steps of a forward pass."""
        return self.first.prepare()

    def forward(self, slot: Float[Tensor, "N Z"], weights: TiledWeights) -> Decoded:
        """Decodes slots; float32 whatever the convolutions run in."""
        pixels = F.elu(self.first(slot, weights), inplace=True)
        x = pixels.unflatten(1, (self.first.size, self.first.size)).permute(0, 3, 1, 2)
        hidden = [x]
        for conv in self.others[:-1]:
            x = F.elu(conv(x), inplace=True)
            hidden.append(x)
        last = self.others[-1]
        assert isinstance(last, nn.Conv2d)
        drawn = full(conv_by_pairs(x, last)).contiguous()
        return Decoded(drawn[:, :3], drawn[:, 3], tuple(hidden))

    @torch.no_grad()
    def pull_back(
        self,
        decoded: Decoded,
        colours: Float[Tensor, "N 3 H W"],
        logits: Float[Tensor, "N H W"],
        weights: TiledWeights,
    ) -> Float[Tensor, "N Z"]:
        """Gradients with respect to colours and logits -> gradient with respect to the slots.

        Autograd would do the same; written out it needs no graph, so inference runs under `no_grad`, and in training
        the graph is left to the one backward pass.
        """
        gradient = torch.cat([colours, logits[:, None]], dim=1).contiguous(memory_format=torch.channels_last)
        for conv, after in zip(reversed(self.others), reversed(decoded.hidden), strict=True):
            assert isinstance(conv, nn.Conv2d)
            gradient = F.conv_transpose2d(gradient, conv.weight, padding=KERNEL // 2)
            gradient = torch.ops.aten.elu_backward(gradient, 1, 1, 1, True, after)  # True: from the ELU's output
        pixels = gradient.permute(0, 2, 3, 1).flatten(1, 2)
        return full(self.first.pull_back(pixels, weights))


def conv_by_pairs(x: Float[Tensor, "N C H W"], conv: nn.Conv2d) -> Float[Tensor, "N C2 H W"]:
    """The same as `conv(x)`, a 5 x 5 convolution to few channels; on a CPU, two neighbouring columns are one.

    A CPU computes 16 channels at once, and four would waste most of that. Channels last, the columns 2 i and 2 i + 1
    are one pixel with twice the channels, and a kernel of 5 x 3 such pixels gives both their results, twice the
    channels: a sixth of the products are with zeros, but half as much is wasted.
    """
    n, channels, height, width = x.shape
    if x.device.type != "cpu" or width % 2 or torch.compiler.is_compiling():
        return conv(x)
    padded = F.pad(conv.weight, (1, 1))
    # of column q of a pair and column p of pair j the tap is 2 j + p - q, from -1 to 5
    taps = torch.stack([padded[..., 1 - q : 7 - q].unflatten(-1, (3, 2)) for q in range(2)])  # (q, C2, C, dy, j, p)
    weight = taps.permute(0, 1, 5, 2, 3, 4).flatten(0, 1).flatten(1, 2)
    assert conv.bias is not None
    pairs = x.permute(0, 2, 3, 1).reshape(n, height, width // 2, 2 * channels).permute(0, 3, 1, 2)
    found = F.conv2d(pairs, weight, conv.bias.repeat(2), padding=(KERNEL // 2, 1))
    return found.permute(0, 2, 3, 1).reshape(n, height, width, conv.out_channels).permute(0, 3, 1, 2)


def start_conv(conv: nn.Conv2d) -> None:
    """Initial weights of a convolution: Xavier-uniform, bias 0."""
    nn.init.xavier_uniform_(conv.weight)
    assert conv.bias is not None
    nn.init.zeros_(conv.bias)

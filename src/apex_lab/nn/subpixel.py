"""Sub-pixel convolution: a 1 x 1 convolution to factor^2 times the channels, laid side by side as pixels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.layout import for_convolutions

LARGE = 16
"""Maps of this side on are made by a transposed convolution, on a CPU: half the time of a convolution and a copy."""


class SubPixelConv(nn.Conv2d):
    """1 x 1 convolution and `nn.PixelShuffle`; its parameters are the convolution's. Channels last on a CPU.

    Args:
        inputs, outputs: channels before and after.
        factor: by which height and width grow.
    """

    def __init__(self, inputs: int, outputs: int, factor: int) -> None:
        super().__init__(inputs, outputs * factor**2, 1)
        self.factor = factor

    def forward(self, x: Float[Tensor, "n inputs h w"]) -> Float[Tensor, "n outputs fh fw"]:
        full = x.dtype in (torch.float32, torch.float64) and not torch.is_autocast_enabled(x.device.type)
        if x.device.type != "cpu" or not full or torch.compiler.is_compiling():
            return for_convolutions(F.pixel_shuffle(super().forward(x), self.factor))
        x = for_convolutions(x)
        return self._transposed(x) if min(x.shape[-2:]) >= LARGE else self._shuffled(x)

    def _shuffled(self, x: Float[Tensor, "n inputs h w"]) -> Float[Tensor, "n outputs fh fw"]:
        """Every row as an image of its own: PyTorch (2.13) has a slow 1 x 1 convolution for fewer than 16 images."""
        n, height = len(x), x.shape[2]
        rows = x.permute(0, 2, 3, 1).reshape(n * height, 1, x.shape[3], -1).permute(0, 3, 1, 2)
        drawn = for_convolutions(F.pixel_shuffle(super().forward(rows), self.factor))
        return drawn.permute(0, 2, 3, 1).reshape(n, height * self.factor, drawn.shape[3], -1).permute(0, 3, 1, 2)

    def _transposed(self, x: Float[Tensor, "n inputs h w"]) -> Float[Tensor, "n outputs fh fw"]:
        """With a stride as large as the kernel, a pixel of the output is a product with the channels of one pixel."""
        kernel = self.weight[..., 0, 0].unflatten(0, (-1, self.factor, self.factor)).permute(3, 0, 1, 2)
        return self._biased(for_convolutions(F.conv_transpose2d(x, kernel, stride=self.factor)))

    def _biased(self, drawn: Float[Tensor, "n outputs fh fw"]) -> Float[Tensor, "n outputs fh fw"]:
        """Adds the bias, which differs between the pixels that come of one pixel, by whole image rows."""
        assert self.bias is not None
        outputs, width = drawn.shape[1], drawn.shape[3]
        bias = self.bias.unflatten(0, (outputs, self.factor, self.factor)).permute(1, 2, 0)  # (f, f, outputs)
        rows = drawn.permute(0, 2, 3, 1).reshape(-1, self.factor, width * outputs)
        rows = rows + bias.repeat(1, width // self.factor, 1).flatten(1)
        return rows.view(len(drawn), -1, width, outputs).permute(0, 3, 1, 2)

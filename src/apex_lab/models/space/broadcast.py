"""The background's component decoder: a spatial broadcast decoder whose broadcast map is never made (section 5).

It is the largest computation of a training step.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.space.networks import conv_elu, cpu_layout, running, update_running
from apex_lab.models.space.stack import draw
from apex_lab.nn.precision import full


class BroadcastDecoder(nn.Module):
    """Spatial broadcast decoder, z_c -> RGB in (0, 1).

    The input is z_c at every pixel of a map 8 pixels larger than the image, plus two channels of coordinates, and four
    unpadded convolutions bring it to the image's size.

    Args:
        latent: length of z_c.
        image_size: side of the image in pixels.
        width: channels of the convolutions; published: 32.
    """

    axis: Tensor

    def __init__(self, latent: int, image_size: int, width: int) -> None:
        super().__init__()
        self.register_buffer("axis", torch.linspace(-1, 1, image_size + 8), persistent=False)
        self.first = conv_elu(latent + 2, width, stride=1, padding=0)
        self.others = nn.Sequential(*(conv_elu(width, width, stride=1, padding=0) for _ in range(3)))
        self.head = nn.Conv2d(width, 3, 1)

    def forward(self, latent: Float[Tensor, "m latent"]) -> Float[Tensor, "m 3 H W"]:
        by_latent, by_place = self._first(latent)
        trains = all(module.training for module in self.modules())  # BatchNorm may be frozen by itself
        if trains and latent.device.type == "cpu" and not (_half(latent) or torch.compiler.is_compiling()):
            return torch.sigmoid(self._drawn(by_latent, by_place))
        return torch.sigmoid(self.head(self.others(F.elu_(by_latent[..., None, None] + cpu_layout(by_place)))))

    def _drawn(self, by_latent: Tensor, by_place: Tensor) -> Float[Tensor, "m 3 H W"]:
        """`others` and `head`, image by image; the running statistics follow."""
        layers: list[tuple[nn.Conv2d, nn.BatchNorm2d]] = []
        for layer in self.others:
            assert isinstance(layer, nn.Sequential)
            conv, norm, _ = layer
            assert isinstance(conv, nn.Conv2d)
            assert isinstance(norm, nn.BatchNorm2d)
            layers.append((conv, norm))
        drawn, statistics = draw(by_latent, cpu_layout(by_place), layers, self.head)
        for (_, norm), found in zip(layers, statistics, strict=True):
            update_running(norm, *found)
        return drawn

    def _first(self, latent: Tensor) -> tuple[Float[Tensor, "m width"], Float[Tensor, "1 width h w"]]:
        """`self.first` of the broadcast map, before its ELU, as two summands: of each latent, and of each place.

        A convolution of a constant channel is a constant, and the coordinates are the same for all. The mean and the
        variance of the sum over latents and places are the sums of theirs, so BatchNorm scales the two before they are
        added.
        """
        conv, norm = self.first[0], self.first[1]
        assert isinstance(conv, nn.Conv2d)
        assert isinstance(norm, nn.BatchNorm2d)
        length = latent.shape[1]
        y, x = torch.meshgrid(self.axis, self.axis, indexing="ij")
        with torch.autocast(latent.device.type, enabled=False):
            weight = conv.weight
            by_latent = F.linear(full(latent), weight[:, :length].sum((2, 3)), conv.bias)
            by_place = F.conv2d(torch.stack([x, y])[None], weight[:, length:])
            if norm.training:
                of_places = by_place.mean((0, 2, 3))
                mean = by_latent.mean(0) + of_places
                spread = (by_place - of_places[:, None, None]).square().mean((0, 2, 3))  # torch.var takes far longer
                variance = by_latent.var(0, unbiased=False) + spread
                update_running(norm, mean, variance, len(latent) * by_place[0, 0].numel())
            else:
                mean, variance = running(norm)
            gain = norm.weight * torch.rsqrt(variance + norm.eps)
            return by_latent * gain + (norm.bias - mean * gain), by_place * gain[:, None, None]


def _half(x: Tensor) -> bool:
    """Whether convolutions of x run in half precision."""
    return x.dtype == torch.bfloat16 or torch.is_autocast_enabled(x.device.type)

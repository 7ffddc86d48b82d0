"""The network that improves the slots' posterior on a frame (op3.md section 4)."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from apex_lab.models.op3.decoder import KERNEL, WIDTH, start_conv
from apex_lab.models.op3.likelihood import ImageGradients, Mixture
from apex_lab.models.op3.posterior import RawGaussian
from apex_lab.nn.precision import full
from apex_lab.nn.tiled_conv import coordinate_maps

CHANNELS = 17
SHARED = (slice(0, 3), slice(10, 11), slice(15, 17))
"""Input channels that are the same for all slots of an image: the frame, the mixture's density, the coordinates."""
OWN = (slice(3, 10), slice(11, 15))
"""Input channels of each slot."""


class ImageNorm(nn.Module):
    """Normalises an image over channels and pixels; the scale of a channel starts uniform in [0, 1).

    Epsilon is added to the (unbiased) standard deviation, not to the variance.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.rand(channels))
        self.shift = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "*batch C H W"]) -> Float[Tensor, "*batch C H W"]:
        std, mean = torch.std_mean(x, dim=(-3, -2, -1), keepdim=True)
        return (x - mean) / (std + 1e-5) * self.scale[:, None, None] + self.shift[:, None, None]


class VectorNorm(nn.Module):
    """Normalises a vector over its entries; epsilon is added to the (unbiased) standard deviation."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(size))
        self.shift = nn.Parameter(torch.zeros(size))

    def forward(self, x: Float[Tensor, "*batch S"]) -> Float[Tensor, "*batch S"]:
        std, mean = torch.std_mean(x, dim=-1, keepdim=True)
        return (x - mean) / (std + 1e-6) * self.scale + self.shift


class _PooledElu(torch.autograd.Function):
    """Mean over the pixels of the ELU.

    Its gradient is written by hand: autograd would first spread the gradient of the mean over a whole tensor, in
    another order of memory than the ELU's.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:  # type: ignore[override]
        x = F.elu(x)
        ctx.save_for_backward(x)
        return x.mean(dim=(-2, -1))

    @staticmethod
    @once_differentiable  # what is kept is neither input nor output, so a second derivative would be wrong
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        each = gradient[..., None, None] / (x.shape[-1] * x.shape[-2])
        return x.clamp_max(0).add_(1).mul_(each)


class Seen(NamedTuple):
    """What a refinement looks at.

    Attributes:
        image: RGB in [0, 1], (B, 3, H, W).
        colours: decoded, (B, K, 3, H, W).
        logits: decoded, (B, K, H, W).
        mixture: of image, colours and logits.
        gradients: of the loss with respect to colours and masks; no gradient goes there.
        to_mean, to_raw: gradients of the loss with respect to the posterior; no gradient goes there. (B, K, S)
        posterior: (B, K, S).
        sample: of the posterior, decoded, (B, K, S).
    """

    image: Tensor
    colours: Tensor
    logits: Tensor
    mixture: Mixture
    gradients: ImageGradients
    to_mean: Tensor
    to_raw: Tensor
    posterior: RawGaussian
    sample: Tensor


Memory = tuple[Tensor, Tensor]
"""Hidden and cell state of the LSTM, each (B K, width)."""


class Refinement(nn.Module):
    """Convolutions over what a slot draws and how well that fits, then an LSTM over the refinements of a frame.

    Args:
        stochastic: S, length of the stochastic state.
        width: of the LSTM and of the layer before it.
        size: H = W in pixels.
    """

    coordinates: Tensor

    def __init__(self, stochastic: int, width: int, size: int) -> None:
        super().__init__()
        widths = (CHANNELS, WIDTH, WIDTH, stochastic)
        self.convs = nn.ModuleList(nn.Conv2d(a, b, KERNEL, padding=KERNEL // 2) for a, b in itertools.pairwise(widths))
        for conv in self.convs:
            assert isinstance(conv, nn.Conv2d)
            start_conv(conv)
        self.compress = nn.Linear(stochastic, width)
        for parameter in self.compress.parameters():
            nn.init.uniform_(parameter, -1e-4, 1e-4)
        self.lstm = nn.LSTMCell(width + 5 * stochastic, width)
        self.to_mean, self.to_raw = nn.Linear(width, stochastic), nn.Linear(width, stochastic)
        self.norm_masks, self.norm_density, self.norm_others = ImageNorm(1), ImageNorm(1), ImageNorm(1)
        self.norm_colours = ImageNorm(3)
        self.norm_mean, self.norm_raw = VectorNorm(stochastic), VectorNorm(stochastic)
        self.register_buffer("coordinates", coordinate_maps(size), persistent=False)

    def start(self, slots: int, like: Tensor) -> Memory:
        """The LSTM's state before the first refinement of a frame."""
        zeros = like.new_zeros(slots, self.lstm.hidden_size)
        return zeros, zeros

    def forward(self, seen: Seen, memory: Memory) -> tuple[RawGaussian, Memory]:
        """The new posterior, which replaces the old one, and the LSTM's new state."""
        b, k = seen.logits.shape[:2]
        pooled = self._features(seen)
        vector = torch.cat(
            [
                full(F.elu(self.compress(pooled))).unflatten(0, (b, k)),
                self.norm_mean(seen.to_mean),
                self.norm_raw(seen.to_raw),
                *seen.posterior,
                seen.sample,
            ],
            dim=-1,
        )
        hidden, cell = self.lstm(vector.flatten(0, 1), memory)
        mean, raw = full(self.to_mean(hidden)), full(self.to_raw(hidden))
        return RawGaussian(mean.unflatten(0, (b, k)), raw.unflatten(0, (b, k))), (hidden, cell)

    def _features(self, seen: Seen) -> Float[Tensor, "N S"]:
        """Features of all slots, pooled over the image; N = B K.

        The first convolution is a sum: what all slots of an image share is convolved once.
        """
        first, *others = self.convs
        assert isinstance(first, nn.Conv2d)
        of_shared, of_own = (torch.cat([first.weight[:, part] for part in parts], dim=1) for parts in (SHARED, OWN))
        shared = F.conv2d(self._shared(seen), of_shared, first.bias, padding=KERNEL // 2)
        own = F.conv2d(self._own(seen), of_own, padding=KERNEL // 2)
        # in place, so that the sum has the layout of `own`
        x = F.elu(own.unflatten(0, (len(shared), -1)).add_(shared[:, None]).flatten(0, 1), inplace=True)
        for conv in others[:-1]:
            x = F.elu(conv(x), inplace=True)
        return full(_PooledElu.apply(others[-1](x)))

    def _shared(self, seen: Seen) -> Float[Tensor, "B 6 H W"]:
        density = self.norm_density(seen.mixture.density.detach()[:, None])
        maps = torch.cat([seen.image, density, self.coordinates.expand(len(density), -1, -1, -1)], dim=1)
        return maps.contiguous(memory_format=torch.channels_last)

    def _own(self, seen: Seen) -> Float[Tensor, "N 11 H W"]:
        masks, by_slot, density = seen.mixture
        responsibility = by_slot / (by_slot.sum(1, keepdim=True) + 1e-8)
        others = (density[:, None] - masks * by_slot).detach()
        maps = [
            seen.colours,
            masks[:, :, None],
            seen.logits[:, :, None],
            responsibility[:, :, None],
            self.norm_masks(seen.gradients.masks[:, :, None]),
            self.norm_others(others[:, :, None]),
            self.norm_colours(seen.gradients.colours),
        ]
        return torch.cat(maps, dim=2).flatten(0, 1).contiguous(memory_format=torch.channels_last)

"""Slot Attention: an auto-encoder of single images whose bottleneck is a set of slots (slot_attention.md).

Legend, beside that of `apex_lab.scene`: N images (B T), L tokens of an image, C channels of a token, D slot size,
h, w height and width of a feature map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.nn.splitting import joined, part_size
from apex_lab.scene import Context, Scene, SceneModel

Count = Annotated[int, Field(gt=0)]
Variant = Literal["released", "strided", "small"]
Padding = Literal["pytorch", "tensorflow"]

NORM_EPS = 1e-3
"""Epsilon of all layer norms: the default of Keras, in which the published model is written."""

ATTENTION_EPS = 1e-8
"""Added to the attention before it is normalised over tokens, so that a slot without a token has weights too."""


EDGE = 2
"""Pixels at a border whose 5 x 5 neighbourhood reaches beyond the image."""


@dataclass(frozen=True)
class Layout:
    """What a variant fixes: default width, and strides of the 5 x 5 convolutions of encoder and decoder."""

    features: int
    encoder: tuple[int, ...]
    decoder: tuple[int, ...]


LAYOUTS: dict[Variant, Layout] = {
    "released": Layout(64, (1, 1, 1, 1), (2, 2, 2, 2, 1)),
    "strided": Layout(64, (1, 2, 2, 1), (2, 2, 2, 2, 1)),
    "small": Layout(32, (1, 1, 1, 1), (1, 1, 1)),
}


class SlotAttention(SceneModel):
    """Object-Centric Learning with Slot Attention (Locatello et al. 2020).

    A convolutional encoder turns an image into tokens, slots compete for the tokens in a few rounds of attention, and a
    decoder draws each slot's colours and mask logits. The masks' mixture of colours is compared with the image.

    Slots start from noise, in evaluation too, so a slot's index means nothing from one frame to the next. The number of
    slots and of iterations can be changed at any time: no weight depends on either (`model.slots = 7`).

    Args:
        image_size: H = W in pixels; a multiple of 16, but for `small`.
        slots: K.
        iterations: rounds of attention.
        variant: `released`: the published encoder, whose convolutions all have stride 1, so every pixel is a token.
            `strided`: 16 times fewer tokens, as in the published set prediction and some other implementations.
            `small`: 32 channels and a decoder that works at full size, a preset for 64 x 64 images.
        features: channels of the convolutions and length of a token; null is the variant's own.
        slot_size: D.
        hidden: of the perceptron that updates a slot.
        padding: where a convolution of stride 2 stands on the pixels. `tensorflow` pads as the published model does and
            is needed for its weights; the two differ by a shift of one pixel.
    """

    term_names = ("mse",)
    tracks = False
    changeable = ("slots", "iterations")

    def __init__(
        self,
        image_size: Count = 128,
        slots: Count = 5,
        iterations: Count = 3,
        variant: Variant = "released",
        features: Count | None = None,
        slot_size: Count = 64,
        hidden: Count = 128,
        padding: Padding = "pytorch",
    ) -> None:
        super().__init__()
        layout = LAYOUTS[variant]
        for strides in (layout.encoder, layout.decoder):
            if image_size % math.prod(strides):
                raise ValueError(f"image_size={image_size} must be a multiple of {math.prod(strides)} for {variant=}")
        self.input_size = (image_size, image_size)
        self.slots, self.iterations, self.slot_size = slots, iterations, slot_size
        features = features or layout.features
        self.encoder = Encoder(features, layout.encoder, padding)
        self.grouping = Grouping(features, slot_size, hidden)
        self.decoder = Decoder(slot_size, features, layout.decoder, image_size, padding)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Explains each frame by itself; `Scene.appearance` is the slots.

        The term `mse` is the squared error in [-1, 1] units, mean over pixels and channels, summed over frames.
        """
        if tuple(video.shape[-2:]) != self.input_size:
            raise ValueError(f"the model was built for {self.input_size} images, the video has {tuple(video.shape)}")
        b, t = video.shape[:2]
        images = 2 * video.flatten(0, 1) - 1
        start = video.new_empty(b * t, self.slots, self.slot_size)
        slots = self.grouping(self.encoder(images), context.noise.at(0, t).normal(start), self.iterations)
        drawn = _precise(self.decoder(slots.flatten(0, 1))).unflatten(0, (b * t, self.slots))
        colours, masks = drawn[:, :, :3], drawn[:, :, 3:].softmax(dim=1)
        mixed = (masks * colours).sum(dim=1)
        error = (mixed - images).square().mean(dim=(1, 2, 3))
        masks = masks.squeeze(2).unflatten(0, (b, t))
        return Scene(
            masks=masks,
            background=torch.zeros(self.slots, dtype=torch.bool, device=video.device),
            ids=torch.arange(self.slots, device=video.device).expand(b, t, -1),
            presence=masks.new_ones(b, t, self.slots),
            appearance=slots.unflatten(0, (b, t)),
            reconstruction=_as_rgb(mixed).unflatten(0, (b, t)),
            terms={"mse": error.unflatten(0, (b, t)).sum(dim=1)},
            means=_as_rgb(colours).unflatten(0, (b, t)) if context.detail else None,
            diagnostics={"slots_in_use": _in_use(masks)},
        )


class PositionEmbedding(nn.Module):
    """A linear map of each pixel's position, added to a feature map (section 3)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(4, channels)

    def forward(self, height: int, width: int) -> Float[Tensor, "C h w"]:
        return self.linear(position_grid(height, width, self.linear.weight)).permute(2, 0, 1)


class Encoder(nn.Module):
    """Image in [-1, 1] -> one token per pixel of the last feature map, rows slowest (section 2)."""

    def __init__(self, features: int, strides: Sequence[int], padding: Padding) -> None:
        super().__init__()
        inputs = (3, *[features] * (len(strides) - 1))
        sizes = zip(inputs, strides, strict=True)
        self.convs = nn.ModuleList(SameConv2d(channels, features, 5, stride, padding) for channels, stride in sizes)
        self.position = PositionEmbedding(features)
        self.norm = nn.LayerNorm(features, eps=NORM_EPS)
        self.mlp = nn.Sequential(nn.Linear(features, features), nn.ReLU(inplace=True), nn.Linear(features, features))
        _initialise(self)

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N L C"]:
        # Channels last: tokens then are the feature map itself, not a copy, and convolutions are faster.
        maps = images.contiguous(memory_format=torch.channels_last)
        for conv in self.convs:
            maps = conv(maps).relu_()
        return self.tokens(maps)

    def tokens(self, maps: Float[Tensor, "N C h w"]) -> Float[Tensor, "N L C"]:
        """Pixels of a feature map, with their position code, normalised one by one."""
        maps = maps + self.position(*maps.shape[-2:])
        return self.mlp(self.norm(maps.permute(0, 2, 3, 1).flatten(1, 2)))


class Grouping(nn.Module):
    """Slots that compete for tokens (section 4)."""

    def __init__(self, features: int, slot_size: int, hidden: int) -> None:
        super().__init__()
        self.mu = nn.Parameter(torch.empty(slot_size))
        self.log_sigma = nn.Parameter(torch.empty(slot_size))
        self.norm_tokens = nn.LayerNorm(features, eps=NORM_EPS)
        self.norm_slots = nn.LayerNorm(slot_size, eps=NORM_EPS)
        self.norm_mlp = nn.LayerNorm(slot_size, eps=NORM_EPS)
        self.to_q = nn.Linear(slot_size, slot_size, bias=False)
        self.to_k = nn.Linear(features, slot_size, bias=False)
        self.to_v = nn.Linear(features, slot_size, bias=False)
        self.gru = nn.GRUCell(slot_size, slot_size)
        self.mlp = nn.Sequential(nn.Linear(slot_size, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, slot_size))
        _initialise(self)
        nn.init.xavier_uniform_(self.gru.weight_ih)
        nn.init.orthogonal_(self.gru.weight_hh)
        nn.init.zeros_(self.gru.bias_ih)
        nn.init.zeros_(self.gru.bias_hh)
        limit = math.sqrt(6 / (1 + slot_size))  # Keras takes the vector for a matrix of 1 x D
        nn.init.uniform_(self.mu, -limit, limit)
        nn.init.uniform_(self.log_sigma, -limit, limit)

    def forward(
        self, tokens: Float[Tensor, "N L C"], noise: Float[Tensor, "N K D"], iterations: int
    ) -> Float[Tensor, "N K D"]:
        """Slots after some rounds of attention, from where the noise, standard normal, makes them start."""
        slots = self.start(noise)
        tokens = self.norm_tokens(tokens)
        for _ in range(iterations):
            slots = self.update(slots, self.attend(slots, tokens), tokens)
        return slots

    def start(self, noise: Float[Tensor, "N K D"]) -> Float[Tensor, "N K D"]:
        """Draws from the one Gaussian that all slots start from."""
        return self.mu + self.log_sigma.exp() * noise

    def attend(self, slots: Float[Tensor, "N K D"], tokens: Float[Tensor, "N L C"]) -> Float[Tensor, "N K L"]:
        """Shares of each (normalised) token that the slots win; they sum to 1 over slots."""
        q = self.to_q(self.norm_slots(slots)) * slots.shape[-1] ** -0.5
        # With k = W x, k . q is x . (W^T q): slots are few and tokens many, so keys are not made. Values neither.
        logits = (q @ self.to_k.weight) @ tokens.transpose(1, 2)
        return _precise(logits).softmax(dim=1)

    def update(
        self, slots: Float[Tensor, "N K D"], attention: Float[Tensor, "N K L"], tokens: Float[Tensor, "N L C"]
    ) -> Float[Tensor, "N K D"]:
        """Slots after a round, each from the mean of the (normalised) tokens' values under its attention."""
        weights = attention + ATTENTION_EPS
        weights = weights / weights.sum(dim=2, keepdim=True)
        values = self.to_v(weights.to(tokens.dtype) @ tokens)
        slots = self.gru(values.flatten(0, 1), slots.flatten(0, 1)).view_as(slots)
        return slots + self.mlp(self.norm_mlp(slots))


class Decoder(nn.Module):
    """Slot -> colours in [-1, 1] (not squashed) and mask logits, from a small grid of copies (section 5)."""

    def __init__(
        self, slot_size: int, features: int, strides: Sequence[int], image_size: int, padding: Padding
    ) -> None:
        super().__init__()
        self.grid = image_size // math.prod(strides)
        self.position = PositionEmbedding(slot_size)
        first, *others = strides
        self.first = SameConvTranspose2d(slot_size, features, 5, first, padding)
        self.convs = nn.ModuleList(SameConvTranspose2d(features, features, 5, stride, padding) for stride in others)
        self.head = SameConvTranspose2d(features, 4, 3, 1, padding)
        self.largest = features * image_size**2
        _initialise(self)

    def forward(self, slots: Float[Tensor, "M D"]) -> Float[Tensor, "M 4 H W"]:
        position = self.position(self.grid, self.grid)
        size = part_size(len(slots), self.largest, slots)
        return joined(self._draw(part, position) for part in slots.split(size))

    def _draw(self, slots: Float[Tensor, "M D"], position: Float[Tensor, "D h w"]) -> Float[Tensor, "M 4 H W"]:
        copies = slots[:, :, None, None]
        if self.first.stride == (1, 1) and self.grid > 2 * EDGE:
            maps = _of_copies(copies, self.first, self.grid) + self.first(position[None])
            maps = maps.contiguous(memory_format=torch.channels_last).relu_()
        else:
            maps = self.first((copies + position).contiguous(memory_format=torch.channels_last)).relu_()
        for conv in self.convs:
            maps = conv(maps).relu_()
        return self.head(maps)


def _of_copies(copies: Float[Tensor, "M D 1 1"], conv: nn.ConvTranspose2d, size: int) -> Float[Tensor, "M C size size"]:
    """What a 5 x 5 convolution of stride 1, without its bias, makes of an image that is the same everywhere.

    Pixels two or more away from the border are equal, so an image of 5 x 5 has all there is: half of the work of the
    `small` decoder is saved.
    """
    maps = F.conv_transpose2d(copies.expand(-1, -1, 2 * EDGE + 1, 2 * EDGE + 1), conv.weight, None, 1, EDGE)
    for dim in (3, 2):
        start, middle, end = maps.split((EDGE, 1, EDGE), dim)
        maps = torch.cat([start, middle.expand(*[-1] * dim, size - 2 * EDGE, *[-1] * (3 - dim)), end], dim)
    return maps


class SameConv2d(nn.Conv2d):
    """Convolution to an output of 1/stride of the size, zeros around the input."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, padding: Padding) -> None:
        super().__init__(inputs, outputs, kernel, stride, padding=kernel // 2)
        self.shifted = padding == "tensorflow" and stride == 2

    def forward(self, x: Float[Tensor, "N C h w"]) -> Float[Tensor, "N C2 h2 w2"]:
        if not self.shifted:
            return super().forward(x)
        # one row and column of zeros less at the start
        before = self.kernel_size[0] // 2 - 1
        x = F.pad(x, (before, before + 1, before, before + 1))
        return F.conv2d(x, self.weight, self.bias, self.stride)


class SameConvTranspose2d(nn.ConvTranspose2d):
    """Transposed convolution to an output of stride times the size."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, padding: Padding) -> None:
        super().__init__(inputs, outputs, kernel, stride, padding=kernel // 2, output_padding=stride - 1)
        self.shifted = padding == "tensorflow" and stride == 2

    def forward(self, x: Float[Tensor, "N C h w"]) -> Float[Tensor, "N C2 h2 w2"]:  # type: ignore[override]
        if not self.shifted:
            return super().forward(x)
        # crops one row and column less at the start, one more at the end
        before = self.kernel_size[0] // 2 - 1
        return F.conv_transpose2d(x, self.weight, self.bias, self.stride, before)[..., :-1, :-1]


def position_grid(height: int, width: int, like: Tensor) -> Float[Tensor, "h w 4"]:
    """Row, column, 1 - row, 1 - column of each pixel, from 0 at the first to 1 at the last."""
    row = torch.linspace(0, 1, height, device=like.device, dtype=like.dtype)[:, None].expand(height, width)
    column = torch.linspace(0, 1, width, device=like.device, dtype=like.dtype).expand(height, width)
    return torch.stack([row, column, 1 - row, 1 - column], dim=-1)


def _initialise(module: nn.Module) -> None:
    """Starting values as in Keras: Glorot uniform weights, biases of zero."""
    for part in module.modules():
        if isinstance(part, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            nn.init.xavier_uniform_(part.weight)
            if part.bias is not None:
                nn.init.zeros_(part.bias)


def _precise(x: Tensor) -> Tensor:
    """At least float32: in half precision epsilons vanish and shares no longer sum to 1."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def _as_rgb(values: Tensor) -> Tensor:
    """[-1, 1], and what lies outside, -> [0, 1]."""
    return ((values + 1) / 2).clamp(0, 1)


def _in_use(masks: Float[Tensor, "B T K H W"]) -> Float[Tensor, ""]:
    """Slots with a hundredth of the image or more: mean over frames."""
    return (masks.detach().mean(dim=(3, 4)) > 0.01).float().sum(dim=2).mean()

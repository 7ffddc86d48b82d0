"""The convolution of a vector that is tiled over an image, without the tiled image.

Away from the border such a convolution has one value per channel; near it, the taps that reach into the zero padding
are missing. So a kernel of 5 gives 5 x 5 different values however large the image is: one linear layer and one copy
take the place of the costliest layer of a spatial broadcast decoder (Watters et al. 2019).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


def coordinate_maps(size: int) -> Float[Tensor, "2 size size"]:
    """x (varies along columns), then y (varies along rows), each from -1 to 1 inclusive."""
    axis = torch.linspace(-1, 1, size)
    return torch.stack([axis.expand(size, size), axis[:, None].expand(size, size)])


def border_taps(kernel: int) -> Float[Tensor, "kernel kernel"]:
    """Which taps (columns) of a kernel stay inside the image for each class of positions (rows), 1 or 0.

    Classes: the first pixels of the axis one by one, then all pixels of the interior, then the last ones one by one.
    """
    missing = torch.arange(kernel) - kernel // 2  # taps cut off: at the start where negative, at the end where positive
    tap = torch.arange(kernel)
    return ((tap >= -missing[:, None]) & (tap < kernel - missing[:, None])).to(torch.get_default_dtype())


def border_classes(size: int, kernel: int) -> Float[Tensor, "kernel size"]:
    """Which class (rows) each position (columns) of an axis belongs to, 1 or 0."""
    position, half = torch.arange(size), kernel // 2
    found = position.clamp_max(half) + (position - (size - 1 - half)).clamp_min(0)
    return F.one_hot(found, kernel).T.to(torch.get_default_dtype())


class _Spread(torch.autograd.Function):
    """Values of the border classes (N, classes, C) and `still` (pixels, C) -> their sum at every pixel (N, pixels, C).

    Forward it is a copy, backward a product with the one-hot `classes` (classes, pixels): each is the faster one.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, still: Tensor, classes: Tensor, index: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(classes)
        return values.index_select(1, index).add_(still)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:  # type: ignore[override]
        (classes,) = ctx.saved_tensors
        kind = gradient.dtype  # bfloat16 under autocast
        by_class = torch.bmm(classes.to(kind).expand(len(gradient), -1, -1), gradient)
        return by_class, gradient.sum(0), None, None


class TiledWeights(NamedTuple):
    """What a `TiledConv` needs of its weights: the same for all vectors, so computed once per forward pass.

    Attributes:
        by_class: vector -> values of the border classes, (Z, classes C).
        still: the share of the coordinate maps and the bias, (H W, C).
    """

    by_class: Tensor
    still: Tensor


class TiledConv(nn.Conv2d):
    """Convolution (stride 1, same size) of a tiled vector and two coordinate maps, in this order of channels.

    Its parameters are those of the plain convolution.

    Args:
        vector: length of the vector, Z.
        outputs: channels C of the result.
        kernel: an odd number.
        size: H = W in pixels; at least `kernel`.
    """

    classes: Tensor
    index: Tensor
    taps: Tensor
    coordinates: Tensor

    def __init__(self, vector: int, outputs: int, kernel: int, size: int) -> None:
        super().__init__(vector + 2, outputs, kernel, padding=kernel // 2)
        if size < kernel:
            raise ValueError(f"an image of {size} px is smaller than the kernel of {kernel}")
        axis = border_classes(size, kernel)
        self.vector, self.size = vector, size
        self.register_buffer("classes", torch.kron(axis, axis), persistent=False)  # (kernel^2, H W)
        self.register_buffer("index", self.classes.argmax(0), persistent=False)  # (H W)
        self.register_buffer("taps", border_taps(kernel), persistent=False)
        self.register_buffer("coordinates", coordinate_maps(size), persistent=False)

    def prepare(self) -> TiledWeights:
        """The weights as `forward` and `pull_back` take them."""
        tiled, maps = self.weight.split([self.vector, 2], dim=1)
        by_class = torch.einsum("ay,bx,czyx->zabc", self.taps, self.taps, tiled)
        still = F.conv2d(self.coordinates[None], maps, self.bias, padding=self.padding)
        return TiledWeights(by_class.flatten(1), still[0].flatten(1).T)

    def forward(  # type: ignore[override]
        self, vector: Float[Tensor, "N Z"], weights: TiledWeights
    ) -> Float[Tensor, "N pixels C"]:
        """Vectors -> the convolution's result, pixels in rows from the top, channels last."""
        values = (vector @ weights.by_class).unflatten(1, (len(self.classes), self.out_channels))
        return _Spread.apply(values, weights.still, self.classes, self.index)

    def pull_back(self, gradient: Float[Tensor, "N pixels C"], weights: TiledWeights) -> Float[Tensor, "N Z"]:
        """Gradient with respect to the result -> gradient with respect to the vectors."""
        values = torch.bmm(self.classes.expand(len(gradient), -1, -1), gradient)
        return values.flatten(1) @ weights.by_class.T

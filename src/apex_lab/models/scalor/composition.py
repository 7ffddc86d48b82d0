"""Depth composition of objects and the likelihood (scalor.md section 8)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.models.scalor.latents import GUARD, full_precision
from apex_lab.models.scalor.windowed import composed, places_of
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import Paster, for_paste
from apex_lab.nn.splitting import joined, part_size


class Layers(NamedTuple):
    """Sums over the components of N frames at every pixel.

    With alpha_k a component's mask (times its presence), kappa_k = alpha_k sigmoid(-z_depth) its importance and y_k its
    colour times its mask:

    alpha (N, H, W): sum of alpha_k. weight (N, H, W): sum of kappa_k. colour (N, 3, H, W): sum of kappa_k y_k.
    share (N, H, W): sum of kappa_k alpha_k, without gradient.
    """

    alpha: Tensor
    weight: Tensor
    colour: Tensor
    share: Tensor


def paster_of(windows: Float[Tensor, "*batch 4"], glimpse: int, size: int) -> Paster:
    """Pastes through windows (s_y, s_x, t_y, t_x) that may have a size of zero."""
    return Paster(for_paste(full(windows)), glimpse, size)


def layers_of(
    drawn: Float[Tensor, "N K 4 g g"],
    presence: Float[Tensor, "N K"],
    depth: Float[Tensor, "N K"],
    windows: Float[Tensor, "N K 4"],
    counted: Float[Tensor, "N K"],
    size: int,
) -> Layers:
    """Pastes components into images of `size` px and sums them.

    Args:
        drawn: o (RGB) and alpha of every component.
        presence: z_pres; zero leaves a component out.
        depth: z_depth; larger is farther away.
        windows: (s_y, s_x, t_y, t_x).
        counted: weight of a component's mask in `Layers.alpha`: 1, or 0 to leave it out there.
        size: H = W in pixels.
    """
    with full_precision(drawn):
        nearness = torch.sigmoid(-full(depth))
        if drawn.device.type == "cpu" and not torch.compiler.is_compiling():
            places = places_of(for_paste(full(windows)), size)
            return Layers(*composed(full(drawn), full(presence), nearness, counted, places))
        each = part_size(len(drawn), 4 * size * size * drawn.shape[1], drawn)
        inputs = [x.split(each) for x in (drawn, presence, nearness, windows, counted)]
        parts = [_layers_of_part(size, *part) for part in zip(*inputs, strict=True)]
        return Layers(*(joined(sums) for sums in zip(*parts, strict=True)))


def _layers_of_part(
    size: int, drawn: Tensor, presence: Tensor, nearness: Tensor, windows: Tensor, counted: Tensor
) -> Layers:
    drawn = full(drawn)
    alpha = drawn[:, :, 3:] * presence[..., None, None, None]
    maps = paster_of(windows, drawn.shape[-1], size).each(torch.cat([drawn[:, :, :3] * alpha, alpha], dim=2))
    mask = maps[:, :, 3:]
    # Sums over components as products of matrices: no weighted copy of the maps is made.
    sums = torch.stack([counted, nearness], dim=1) @ mask.flatten(2)
    products = nearness[:, None] @ (maps * mask).flatten(2)
    alpha_sum, weight = sums.unflatten(-1, (size, size)).unbind(1)
    colour, share = products.reshape(-1, 4, size, size).split([3, 1], dim=1)
    return Layers(alpha_sum, weight, colour, share.squeeze(1).detach())


class _ClampThrough(torch.autograd.Function):
    """Clamps to [1e-15, 1 - 1e-15]; the gradient passes as if it had not."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:  # type: ignore[override]
        return x.clamp(GUARD, 1 - GUARD)  # in float32 the upper bound is exactly 1

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        return grad


def clamped(alpha: Float[Tensor, "*batch H W"]) -> Float[Tensor, "*batch H W"]:
    """A, the foreground's mask, from the sum of the components' masks, with a straight-through gradient."""
    return _ClampThrough.apply(alpha)


def log_likelihood(
    images: Float[Tensor, "*batch 3 H W"], means: Float[Tensor, "*batch 3 H W"], sigma: float
) -> Float[Tensor, "*batch"]:
    """log N(x; y, sigma^2), summed over channels and pixels; nats."""
    constant = -math.log(sigma) - 0.5 * math.log(2 * math.pi)
    values = math.prod(images.shape[-3:])
    return values * constant - (images - means).square().sum((-3, -2, -1)) / (2 * sigma**2)

"""The attributes of an object, their distributions, and the random numbers of a video (gswm.md sections 1, 12, 15).

An object is one vector Z: presence 1, depth 1, where 4, what, dynamics. `where` is (s_x, s_y, t_x, t_y), x first, as
published; `apex_lab.models.gswm.boxes` turns it into the windows of the spatial transformers.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn import distributions
from apex_lab.nn.distributions import LOG_GUARD, Gaussian, relaxed_logit
from apex_lab.nn.precision import full
from apex_lab.scene import Noise

MIN_STD = 1e-4
"""Added to the softplus of every raw standard deviation."""

DEPTH, WHERE = 1, 4
"""Lengths of z_depth and z_where."""

SHIFT = slice(4, 6)
"""Where the centre (t_x, t_y) of the box stands in Z."""

Latents = Literal["sample", "mean"]


class Attributes(NamedTuple):
    """The parts of Z: pres (..., 1), depth (..., 1), where (..., 4), what (..., what), dyna (..., dyna)."""

    pres: Tensor
    depth: Tensor
    where: Tensor
    what: Tensor
    dyna: Tensor

    def joined(self) -> Tensor:
        """Z."""
        return torch.cat(self, dim=-1)


def attributes(z: Float[Tensor, "... Z"], what: int) -> Attributes:
    """Z -> its parts; `what` is the length of z_what."""
    return Attributes(*z.split([1, DEPTH, WHERE, what, z.shape[-1] - 1 - DEPTH - WHERE - what], dim=-1))


def gaussian(raw: Float[Tensor, "... two_D"]) -> Gaussian:
    """A network's output -> mean and standard deviation, softplus(raw) + 1e-4."""
    mean, spread = full(raw).chunk(2, dim=-1)
    return Gaussian(mean, F.softplus(spread) + MIN_STD)


def relaxed_bernoulli(
    prob: Float[Tensor, "..."], temperature: Float[Tensor, ""], uniform: Float[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Sample of the binary concrete distribution from uniform numbers; probabilities and numbers stay in (0, 1)."""
    info = torch.finfo(prob.dtype)
    logit = relaxed_logit(prob, temperature, uniform, info.eps)
    return torch.sigmoid(logit).clamp(info.tiny, 1 - info.eps)


def kl_bernoulli(q: Float[Tensor, "*shape"], p: Float[Tensor, ""]) -> Float[Tensor, "*shape"]:
    """KL(Bernoulli(q) || Bernoulli(p)) of probabilities, elementwise; nats. 1e-15 inside every logarithm."""
    return distributions.kl_bernoulli(q, p, added=LOG_GUARD)


class Draws(NamedTuple):
    """Random numbers of a video: standard normal ones, and uniform ones in [0, 1).

    context (B, T, z_ctx): of the background.
    cells (B, T, G^2, depth + where + what + dyna), slots (B, T, M, the same): of discovery and of propagation.
    cell_presence (B, T, G^2), slot_presence (B, T, M), discover (B, T, 2): uniform.
    """

    context: Tensor
    cells: Tensor
    slots: Tensor
    cell_presence: Tensor
    slot_presence: Tensor
    discover: Tensor


def draw(
    noise: Noise, like: Float[Tensor, "B T ..."], context: int, cells: int, slots: int, each: int, latents: Latents
) -> Draws:
    """All random numbers of B T frames in two draws.

    Args:
        noise: where they come from.
        like: a tensor of the videos.
        context: length of z_ctx.
        cells: of discovery, G^2.
        slots: M.
        each: normal numbers per object: lengths of depth, where, what and dyna together.
        latents: with `mean`, every Gaussian latent is its mean, and presence is its probability (at temperature 1).
    """
    b, t = like.shape[:2]
    dtype = torch.promote_types(like.dtype, torch.float32)
    normal = like.new_zeros((b * t, context + (cells + slots) * each), dtype=dtype)
    uniform = like.new_full((b * t, cells + slots + 2), 0.5, dtype=dtype)
    if latents == "sample":
        source = noise.at(0, t)
        normal, uniform = source.normal(normal), source.uniform(uniform)
    ctx, of_cells, of_slots = normal.unflatten(0, (b, t)).split([context, cells * each, slots * each], dim=-1)
    return Draws(
        ctx,
        of_cells.unflatten(-1, (cells, each)),
        of_slots.unflatten(-1, (slots, each)),
        *uniform.unflatten(0, (b, t)).split([cells, slots, 2], dim=-1),
    )

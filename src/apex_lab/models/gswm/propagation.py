"""Propagation: the objects of the frame before in this frame (gswm.md section 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.models.gswm.boxes import enlarged
from apex_lab.models.gswm.latents import DEPTH, WHERE, Attributes, gaussian, relaxed_bernoulli
from apex_lab.models.gswm.networks import Encoder
from apex_lab.nn.blocks import mlp
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import crop, window_of

Size = Annotated[float, Field(ge=0)]

SMALLEST, LARGEST = 0.02, 1.0
"""Sizes of propagated boxes under `Motion.bounded`, as shares of the image side: 2.6 to 128 of 128 pixels."""


@dataclass(frozen=True)
class Motion:
    """How far attributes may change from one frame to the next.

    Args:
        grow_min, grow_max: the box that propagation looks at is larger than the object's by this much at least and at
            most, as a share of the image side.
        scale: largest change of a size, as a share of the image side.
        shift: largest change of a centre, in [-1, 1] coordinates.
        depth: what the change of z_depth is multiplied by; it has no bound.
        what: largest change of an entry of z_what.
        bounded: keep the sizes of propagated boxes between `SMALLEST` and `LARGEST`, with no gradient beyond. As
            published there is no bound: a size may pass through zero, by which pasting divides, and mirror its glimpse.
    """

    grow_min: Size = 0.1
    grow_max: Size = 0.3
    scale: Size = 0.3
    shift: Size = 0.6
    depth: Size = 1.0
    what: Size = 0.2
    bounded: bool = False


class Propagated(NamedTuple):
    """What the loss needs of the propagated slots of a frame; with (B, T) in front of a video's.

    prob (B, M): probability that a slot's object stays present. raw_dyna (B, M, 2 dyna): posterior of z_dyna, mean and
    raw standard deviation. p_hidden (B, M, hidden): state that the prior of z_dyna is computed from.
    """

    prob: Tensor
    raw_dyna: Tensor
    p_hidden: Tensor


class Propagation(nn.Module):
    """Slots and a frame -> the same objects in it.

    Only z_dyna has a posterior and a prior of its own; the attributes are sampled given z_dyna from one conditional
    that both share, so they cost no KL.

    Args:
        what, dyna: lengths of z_what and z_dyna.
        hidden: of the networks.
        glimpse: side of the crops in pixels.
        widths: channels of the crops' encoder.
        motion: how far attributes may change.
    """

    def __init__(self, what: int, dyna: int, hidden: int, glimpse: int, widths: Sequence[int], motion: Motion) -> None:
        super().__init__()
        self.what, self.glimpse, self.motion = what, glimpse, motion
        self.grow_net = mlp([hidden, hidden, hidden, 2])
        self.encoder = Encoder(glimpse, widths, hidden)
        self.q_net = mlp([2 * hidden, hidden, hidden, 2 * dyna])
        self.p_net = mlp([hidden, hidden, hidden, 2 * dyna])
        self.change_net = mlp([dyna, hidden, hidden, 1 + 3 * (DEPTH + WHERE + what)])

    def prior(self, p_hidden: Float[Tensor, "... hidden"]) -> Gaussian:
        """p(z_dyna) from the prior's state after the frame before."""
        return gaussian(self.p_net(p_hidden))

    def forward(
        self,
        before: Attributes,
        hidden: Float[Tensor, "2 B M hidden"],
        image: Float[Tensor, "B 3 H W"],
        noise: Float[Tensor, "B M N"],
        uniform: Float[Tensor, "B M"],
        temperature: Float[Tensor, ""],
    ) -> tuple[Attributes, Propagated]:
        """Attributes at t - 1 and both states (posterior's, prior's) after it -> attributes at t."""
        q_hidden, p_hidden = hidden.unbind()
        low, high = self.motion.grow_min, self.motion.grow_max
        proposal = enlarged(before.where, low + (high - low) * torch.sigmoid(full(self.grow_net(q_hidden))))
        crops = crop(image, window_of(proposal), self.glimpse)
        code = self.encoder(crops.flatten(0, 1)).unflatten(0, crops.shape[:2])
        raw_dyna = self.q_net(torch.cat([code, q_hidden.to(code.dtype)], dim=-1))
        q_dyna = gaussian(raw_dyna)
        gaussians = DEPTH + WHERE + self.what
        drawn_rest, drawn_dyna = noise.split([gaussians, noise.shape[-1] - gaussians], dim=-1)
        dyna = q_dyna.mean + q_dyna.std * drawn_dyna

        chance, rest, gates = full(self.change_net(dyna)).split([1, 2 * gaussians, gaussians], dim=-1)
        prob = torch.sigmoid(chance[..., 0])
        parts = [gaussian(part) for part in rest.split([2 * DEPTH, 2 * WHERE, 2 * self.what], dim=-1)]
        mean, std = (torch.cat(values, dim=-1) for values in zip(*parts, strict=True))
        depth, where, what = self.moved(before, mean + std * drawn_rest, torch.sigmoid(gates))
        stays = relaxed_bernoulli(prob, temperature, uniform)
        after = Attributes(before.pres * stays[..., None], depth, where, what, dyna)
        return after, Propagated(prob, raw_dyna, p_hidden)

    def moved(
        self, before: Attributes, change: Float[Tensor, "B M N"], gates: Float[Tensor, "B M N"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Depth, where and what after a change that the gates in (0, 1) let through."""
        depth, size, shift, what = change.split([DEPTH, 2, 2, self.what], dim=-1)
        gate_depth, gate_where, gate_what = gates.split([DEPTH, WHERE, self.what], dim=-1)
        motion = self.motion
        step = torch.cat([motion.scale * torch.tanh(size), motion.shift * torch.tanh(shift)], dim=-1)
        where = before.where + gate_where * step
        if motion.bounded:
            where = torch.cat([where[..., :2].clamp(SMALLEST, LARGEST), where[..., 2:]], dim=-1)
        return (
            before.depth + motion.depth * gate_depth * depth,
            where,
            before.what + motion.what * gate_what * torch.tanh(what),
        )

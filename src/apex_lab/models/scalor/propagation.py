"""Propagation: objects of the frame before -> objects of this frame, and their prior (scalor.md section 6)."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import same
from apex_lab.models.scalor.encoder import FEATURES
from apex_lab.models.scalor.glimpses import GlimpseEncoder
from apex_lab.models.scalor.latents import Sampler, bounded_logit, full_precision, gaussian_of
from apex_lab.models.scalor.recompute import Recompute
from apex_lab.models.scalor.slots import Objects
from apex_lab.models.scalor.windows import SizeRule, propagated
from apex_lab.nn.blocks import mlp
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.precision import full
from apex_lab.nn.slots import leading, padded
from apex_lab.nn.spatial_transformer import crop, window_of

PRESENT_AT_FIRST = 2.0
"""Added to the raw presence logit: objects stay."""

PRESENT_BY_PRIOR = 5.0
"""The same in the prior."""

WHERE_OFFSET = -2.0
"""Added to the raw standard deviation of z_where: boxes start to move little."""


class Propagated(NamedTuple):
    """Propagated objects of a frame with their posteriors; (B, P, ...).

    objects: samples; presence is zero where the slot is empty or the object was stopped.
    where, what, depth: Gaussians. logit (B, P): of the presence.
    """

    objects: Objects
    where: Gaussian
    what: Gaussian
    depth: Gaussian
    logit: Tensor


class PropagationPrior(nn.Module):
    """p(z_t | z_<t) of propagated objects; knows nothing of this frame.

    Args:
        what: length of z_what.
        hidden: of the LSTM.
    """

    def __init__(self, what: int, hidden: int = 64) -> None:
        super().__init__()
        self.input = nn.Linear(what + 4 + 4 + 1 + 1, 128)
        self.rnn = nn.LSTMCell(128, hidden)
        self.what = nn.Linear(hidden, 2 * what)
        self.where = nn.Linear(hidden, 8)
        self.depth = nn.Linear(hidden, 2)
        self.presence = nn.Linear(hidden, 1)

    def step(self, before: Objects) -> tuple[Float[Tensor, "B P hidden"], Float[Tensor, "B P hidden"]]:
        """Objects of the frame before -> the LSTM's state (h, c) at this frame."""
        seen = torch.cat([before.what, before.where, before.raw, before.depth, before.presence], dim=-1)
        count = seen.shape[:2]
        state = (before.prior_h.flatten(0, 1), before.prior_c.flatten(0, 1))
        h, c = self.rnn(self.input(seen).flatten(0, 1).to(state[0].dtype), state)
        return h.unflatten(0, count), c.unflatten(0, count)

    def heads(self, h: Float[Tensor, "*batch hidden"]) -> tuple[Gaussian, Gaussian, Gaussian, Float[Tensor, "*batch"]]:
        """Priors of z_what, the raw z_where and z_depth, and the probability to be present."""
        present = torch.sigmoid(full(self.presence(h)) + PRESENT_BY_PRIOR).squeeze(-1)
        return gaussian_of(self.what(h)), gaussian_of(self.where(h)), gaussian_of(self.depth(h)), present


class Propagation(nn.Module):
    """q(z_t | z_<t, x_<=t) of objects that are carried on.

    Args:
        grid: G.
        what: length of z_what.
        size: rule of a box's size.
        stop: an object whose absence, summed over its life, reaches this is deleted.
        hidden: of the tracker.
    """

    def __init__(self, grid: int, what: int, size: SizeRule, stop: float, hidden: int = 128) -> None:
        super().__init__()
        code = 128
        self.size, self.stop, self.look = size, stop, grid // 2
        self.attention = nn.Sequential(*same(FEATURES, FEATURES, kernel=1))
        self.attention_code = nn.Linear(FEATURES * self.look**2, code)
        self.tracker_input = nn.Linear(4 + 1 + what + 4 + code, hidden)
        self.tracker = nn.GRUCell(hidden, hidden)
        self.where = mlp([hidden + what + 4 + 4 + code, 128, 8])
        self.what = mlp([hidden, 64, 2 * what])
        self.gates = mlp([hidden + code, 64, 2])
        self.depth = mlp([hidden + what + code, 128, 2])
        self.presence = mlp([hidden + 4 + 4 + what, 64, 1])
        self.prior = PropagationPrior(what)

    def forward(
        self,
        before: Objects,
        valid: Bool[Tensor, "B P"],
        features: Float[Tensor, "B 64 G G"],
        image: Float[Tensor, "B 3 H W"],
        encoder: GlimpseEncoder,
        sampler: Sampler,
        recompute: Recompute,
    ) -> Propagated:
        """Slots of the frame before -> this frame."""
        prior_h, prior_c = self.prior.step(before)
        code = self._attend(features, before.where)
        tracker = self._track(before, code)

        evidence = torch.cat([tracker, before.what, before.where, before.raw, code], dim=-1)
        q_where = gaussian_of(self.where(evidence), WHERE_OFFSET)
        raw = sampler.gaussian(q_where)
        where = propagated(raw, before.where, self.size)

        looked_at = window_of(where)[:, : leading(valid)]
        glimpse = padded(recompute(encoder, image, looked_at), valid.shape[1])
        q_what = self._appearance(glimpse, tracker, code)
        what = sampler.gaussian(q_what)
        q_depth = gaussian_of(self.depth(torch.cat([tracker, what, code], dim=-1)))
        depth = sampler.gaussian(q_depth)

        logit = bounded_logit(self.presence(torch.cat([tracker, where, raw, what], dim=-1)), PRESENT_AT_FIRST)
        presence = sampler.presence(logit)
        # The stop rule: absence adds up over an object's life and never goes down. Only compared, so no gradient.
        absence = before.absence + (1 - presence.detach())
        presence = torch.where(valid[..., None] & (absence < self.stop), presence, torch.zeros_like(presence))
        objects = Objects(what, where, raw, depth, presence, tracker, prior_h, prior_c, absence)
        return Propagated(objects, q_where, q_what, q_depth, logit.squeeze(-1))

    def _attend(self, features: Tensor, where: Float[Tensor, "B P 4"]) -> Float[Tensor, "B P code"]:
        """What e_t shows around each object's last place, in a window of half the image; no gradient to the place."""
        half = torch.full_like(where[..., :2], 0.5)
        windows = window_of(torch.cat([half, where[..., 2:].detach()], dim=-1))
        with full_precision(features):
            seen = crop(full(features), windows, self.look)
        return self.attention_code(self.attention(seen.flatten(0, 1)).flatten(1)).unflatten(0, where.shape[:2])

    def _track(self, before: Objects, code: Float[Tensor, "B P code"]) -> Float[Tensor, "B P hidden"]:
        seen = torch.cat([before.where, before.presence, before.what, before.raw, code], dim=-1)
        hidden = before.tracker.flatten(0, 1)
        after = self.tracker(self.tracker_input(seen).flatten(0, 1).to(hidden.dtype), hidden)
        return after.unflatten(0, code.shape[:2])

    def _appearance(
        self,
        glimpse: Float[Tensor, "B P two_Z"],
        tracker: Float[Tensor, "B P hidden"],
        code: Float[Tensor, "B P code"],
    ) -> Gaussian:
        """z_what from the glimpse and from the past."""
        gates = torch.sigmoid(full(self.gates(torch.cat([tracker, code], dim=-1))))
        return gated(gaussian_of(glimpse), gaussian_of(self.what(tracker)), gates)


def gated(glimpse: Gaussian, temporal: Gaussian, gates: Float[Tensor, "*batch 2"]) -> Gaussian:
    """The posterior of z_what from what is seen and what was known.

    The standard deviation goes through a second softplus, as published, so it is never below log 2.

    Args:
        glimpse: of the glimpse encoder.
        temporal: of the tracker.
        gates: forget gate (weight of `temporal`), input gate (weight of `glimpse`), in (0, 1).
    """
    forget, into = gates.split(1, dim=-1)
    mean = into * glimpse.mean + forget * temporal.mean
    return Gaussian(mean, F.softplus(into * glimpse.std + forget * temporal.std))

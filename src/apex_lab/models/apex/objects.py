"""Foreground objects: the posterior of each, by propagation and by discovery, and its prior.

Symbols as in apex.md: z_what (appearance and mask), z_where (window), z_pres (presence).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.apex.glimpses import Glimpses
from apex_lab.models.apex.windows import Windows, square_of, window_of
from apex_lab.nn.blocks import mlp
from apex_lab.nn.distributions import Gaussian, gaussian_from, relaxed_bernoulli, standard_normal
from apex_lab.nn.slots import gather_fields, inverse_of
from apex_lab.scene import Noise

NARROW = -3.0
"""Where heads start the softplus of z_where's standard deviation: at 0.05, under two pixels of 64 for a centre."""


class Objects(NamedTuple):
    """State of K objects after a frame; everything that the next frame needs.

    what (B, K, Z); place (B, K, 4), see windows.py; presence (B, K) in [0, 1]; hidden states of the four recurrent
    networks (B, K, hidden).
    """

    what: Tensor
    place: Tensor
    presence: Tensor
    hidden_where: Tensor
    hidden_what: Tensor
    hidden_pres: Tensor
    hidden_prior: Tensor

    def packed(self) -> Float[Tensor, "B K C"]:
        """All fields side by side, so that one operation moves all of an object."""
        return torch.cat([x if x.dim() == 3 else x[..., None] for x in self], dim=2)

    def unpacked(self, packed: Float[Tensor, "B S C"]) -> Objects:
        """Objects with fields as wide as those of `self`."""
        parts = packed.split([x.shape[2] if x.dim() == 3 else 1 for x in self], dim=2)
        return Objects(*(part if x.dim() == 3 else part.squeeze(2) for part, x in zip(parts, self, strict=True)))

    @staticmethod
    def empty(batch: int, slots: int, what: int, hidden: int, like: Tensor) -> Objects:
        """`slots` empty slots per video."""
        zeros = [like.new_zeros(batch, slots, n) for n in (what, 4, hidden, hidden, hidden, hidden)]
        return Objects(zeros[0], zeros[1], like.new_zeros(batch, slots), *zeros[2:])


class Posterior(NamedTuple):
    """q of one set of objects, and the hidden state of the network that gives their prior (B, K, hidden)."""

    q_where: Gaussian
    q_what: Gaussian
    q_pres: Tensor
    hidden_prior: Tensor


def spread(
    objects: Objects,
    posterior: Posterior,
    slots: Int[Tensor, "B n"],
    valid: Bool[Tensor, "B P"],
) -> tuple[Objects, Posterior]:
    """What is known of the objects in some slots -> in all; empty ones get another object's, and no presence."""
    where, what, pres, _ = posterior
    moved = gather_fields([*objects, *where, *what, pres], inverse_of(slots, valid.shape[1]))
    of_objects, (m_where, s_where, m_what, s_what, pres) = moved[: len(objects)], moved[len(objects) :]
    found = Objects(*of_objects)
    found = found._replace(presence=torch.where(valid, found.presence, torch.zeros_like(found.presence)))
    return found, Posterior(Gaussian(m_where, s_where), Gaussian(m_what, s_what), pres, found.hidden_prior)


class Beliefs(NamedTuple):
    """Distributions of one set of objects: q (posterior) and p (prior)."""

    q_where: Gaussian
    p_where: Gaussian
    q_what: Gaussian
    p_what: Gaussian
    q_pres: Tensor
    p_pres: Tensor


def sample_presence(prob: Tensor, temperature: Tensor, noise: Noise | None) -> Tensor:
    """Relaxed Bernoulli; without noise (evaluation) the hard decision prob > 0.5."""
    return (prob > 0.5).to(prob.dtype) if noise is None else relaxed_bernoulli(prob, temperature, noise)


def _set_last_bias(network: nn.Sequential, values: Float[Tensor, " n"], shrink: float = 0.1) -> None:
    """Starts a head at a chosen output: small weights, given biases."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(shrink)
        last.bias.copy_(values)


class Appearance(nn.Module):
    """q(z_what): one RNN on [glimpse code, z_what_{t-1}], shared by propagation and discovery (z_what_0 = 0).

    Args:
        code: length of a glimpse code.
        what: length of z_what.
        hidden: of the RNN.
        start_std: standard deviation of q at the start of training.
        shortcut: whether the head sees the code too; not in the paper.
    """

    def __init__(self, code: int, what: int, hidden: int, start_std: float, shortcut: bool = True) -> None:
        super().__init__()
        self.what, self.shortcut = what, shortcut
        self.rnn = nn.GRUCell(code + what, hidden)
        self.head = nn.Linear(hidden + code if shortcut else hidden, 2 * what)
        # Start as a network without memory: then a propagated object looks just as it would if it were discovered in
        # its window, and its presence does not die before propagation has learned anything.
        with torch.no_grad():
            self.rnn.weight_ih[:, code:] = 0
            self.rnn.weight_hh.zero_()
            self.rnn.bias_ih[hidden : 2 * hidden] = -3.0  # update gate: take the new state
            self.head.weight[:what].mul_(4.0)  # codes differ between objects from the first step on
            self.head.bias[what:] = math.log(math.expm1(start_std))  # the softplus's inverse

    def forward(self, code: Tensor, what: Tensor, hidden: Tensor) -> tuple[Gaussian, Tensor]:
        """(N, code), (N, Z), (N, hidden) -> q(z_what), new hidden state."""
        hidden = self.rnn(torch.cat([code, what], dim=-1), hidden)
        seen = torch.cat([hidden, code], dim=-1) if self.shortcut else hidden
        return gaussian_from(self.head(seen)), hidden


class Propagation(nn.Module):
    """q (Eq. 15) and p (Eq. 5) of objects that existed in the frame before.

    Args:
        code: length of a glimpse code.
        what: length of z_what.
        hidden: of the recurrent networks.
        windows: squashes z_where.
    """

    def __init__(self, code: int, what: int, hidden: int, windows: Windows) -> None:
        super().__init__()
        self.windows = windows
        self.rnn_where = nn.GRUCell(code + what + 4, hidden)
        self.rnn_pres = nn.GRUCell(code + what + 1, hidden)
        self.rnn_prior = nn.GRUCell(what + 5, hidden)
        self.head_where = mlp([hidden, hidden, 8])
        self.head_pres = mlp([hidden, hidden, 1])
        self.prior_what = mlp([hidden, hidden, 2 * what])
        self.prior_where = mlp([hidden, hidden, 8])
        self.prior_pres = mlp([hidden, hidden, 1])
        still = torch.tensor([0.0] * 4 + [NARROW] * 4)  # no change
        _set_last_bias(self.head_where, still)
        _set_last_bias(self.prior_where, still)
        stays = torch.tensor([3.0])  # a priori an object stays
        _set_last_bias(self.head_pres, stays)
        _set_last_bias(self.prior_pres, stays)

    def forward(
        self,
        before: Objects,
        glimpses: Glimpses,
        appearance: Appearance,
        glimpse_source: Float[Tensor, "B C h w"],
        crop_source: Float[Tensor, "B C2 h w"],
        valid: Bool[Tensor, "B P"],
        temperature: Tensor,
        noise: Noise | None,
    ) -> tuple[Objects, Posterior]:
        """Objects at t - 1 and the sources at t -> objects at t, with their posterior."""
        b, p = before.presence.shape

        def each(cell: nn.GRUCell, hidden: Tensor, *inputs: Tensor) -> Tensor:
            return cell(torch.cat(inputs, dim=-1).flatten(0, 1), hidden.flatten(0, 1)).unflatten(0, (b, p))

        window = window_of(before.place)
        presence = before.presence[..., None]
        # Eq. 5: the prior sees the frame before and nothing of this one
        hidden_prior = each(self.rnn_prior, before.hidden_prior, before.what, window, presence)

        # Eq. 15, last factor: z_where
        crop_code = glimpses.follow(crop_source, square_of(window))
        hidden_where = each(self.rnn_where, before.hidden_where, crop_code, before.what, window)
        q_where = gaussian_from(self.head_where(hidden_where))
        place = self.windows.propagated(before.place, q_where.sample(noise))

        # Eq. 15, second factor: z_what
        code = glimpses.look(glimpse_source, window_of(place))
        q_flat, hidden_flat = appearance(
            code.flatten(0, 1), before.what.flatten(0, 1), before.hidden_what.flatten(0, 1)
        )
        q_what, hidden_what = Gaussian(*(x.unflatten(0, (b, p)) for x in q_flat)), hidden_flat.unflatten(0, (b, p))
        what = q_what.sample(noise)

        # Eq. 15, first factor: z_pres
        hidden_pres = each(self.rnn_pres, before.hidden_pres, crop_code, what, presence)
        q_pres = torch.sigmoid(self.head_pres(hidden_pres)).squeeze(-1)
        z_pres = torch.where(valid, sample_presence(q_pres, temperature, noise), torch.zeros_like(q_pres))

        objects = Objects(what, place, z_pres, hidden_where, hidden_what, hidden_pres, hidden_prior)
        return objects, Posterior(q_where, q_what, q_pres, hidden_prior)

    def nothing(self, before: Objects, noise: Noise | None) -> tuple[Objects, Posterior]:
        """What `forward` gives where no slot holds an object, without the work; it draws as many numbers."""
        if noise is not None:
            noise.normal(torch.empty_like(before.place))
            noise.normal(torch.empty_like(before.what))
            noise.uniform(torch.empty_like(before.presence))
        objects = Objects(*(torch.zeros_like(x) for x in before))
        return objects, Posterior(
            standard_normal(before.place), standard_normal(before.what), objects.presence, objects.hidden_prior
        )

    def beliefs(self, posterior: Posterior) -> Beliefs:
        """With the prior (Eq. 5), which nothing in the loop over time waits for; any leading shape, such as (B, T)."""
        q_where, q_what, q_pres, hidden = posterior
        return Beliefs(
            q_where,
            gaussian_from(self.prior_where(hidden)),
            q_what,
            gaussian_from(self.prior_what(hidden)),
            q_pres,
            torch.sigmoid(self.prior_pres(hidden)).squeeze(-1),
        )


class Proposals(NamedTuple):
    """What discovery proposes in every cell, before the context is known; (F, D, ...) for F frames, or (B, T, D, ...).

    q_where, q_what; what, place: samples; prob: p_proposal; hidden_what: of the appearance RNN.
    """

    q_where: Gaussian
    q_what: Gaussian
    what: Tensor
    place: Tensor
    prob: Tensor
    hidden_what: Tensor

    def over_time(self, shape: tuple[int, int], frames: Int[Tensor, " F"] | None) -> Proposals:
        """Of all frames of B videos, shape (B, T): those at `frames` (None: all), nothing proposed in the others."""
        q_where, q_what = (
            Gaussian(at_frames(x.mean, shape, frames), at_frames(x.std, shape, frames, 1.0))
            for x in (self.q_where, self.q_what)
        )
        rest = (self.what, self.place, self.prob, self.hidden_what)
        return Proposals(q_where, q_what, *(at_frames(x, shape, frames) for x in rest))


def at_frames(
    values: Float[Tensor, "N ..."], shape: tuple[int, int], frames: Int[Tensor, " N"] | None, empty: float = 0.0
) -> Float[Tensor, "B T ..."]:
    """Values at some of B T frames (None: all) -> at all, `empty` at the others."""
    if frames is None:
        return values.unflatten(0, shape)
    return (
        values.new_full((shape[0] * shape[1], *values.shape[1:]), empty)
        .index_copy(0, frames, values)
        .unflatten(0, shape)
    )


class Discovery(nn.Module):
    """Proposals of new objects (Eq. 16). Nothing here depends on the frame before, so all frames run at once.

    Args:
        features: F.
        grid: G, cells per side.
        what, hidden: as in `Propagation`.
        windows: squashes z_where.
        size_logit: mean of the window size's logit at the start of training.
        presence: p_proposal at the start of training, in (0, 1).
    """

    def __init__(
        self, features: int, grid: int, what: int, hidden: int, windows: Windows, size_logit: float, presence: float
    ) -> None:
        super().__init__()
        self.grid, self.windows = grid, windows
        self.head_where = nn.Conv2d(features, 8, 1)
        self.head_pres = mlp([features + what + 4, hidden, 1])
        with torch.no_grad():
            self.head_where.weight.mul_(0.1)
            assert self.head_where.bias is not None
            self.head_where.bias.copy_(torch.tensor([size_logit] * 2 + [0.0] * 2 + [NARROW] * 4))
        _set_last_bias(self.head_pres, torch.logit(torch.tensor([presence])))

    def forward(
        self,
        features: Float[Tensor, "F C h w"],
        glimpse_source: Float[Tensor, "F C2 h2 w2"],
        glimpses: Glimpses,
        appearance: Appearance,
        noise: Noise | None,
    ) -> Proposals:
        """Feature maps -> proposals of all cells of all frames, (F, D, ...)."""
        step = features.shape[-1] // self.grid
        cells = features[..., step // 2 :: step, step // 2 :: step]  # c_d, equally spaced
        d = self.grid**2
        # Eq. 16, last factor: z_where
        raw = self.head_where(cells).contiguous()  # in this layout noise is drawn, on every device
        q_where = gaussian_from(raw.flatten(2).transpose(1, 2))  # (F, D, 4)
        place = self.windows.discovered(q_where.sample(noise))
        window = window_of(place)

        # Eq. 16, second factor: z_what
        code = glimpses.look(glimpse_source, window).flatten(0, 1)
        nothing = code.new_zeros(code.shape[0], appearance.what)
        q_what, hidden = appearance(code, nothing, code.new_zeros(code.shape[0], appearance.rnn.hidden_size))
        what = q_what.sample(noise).unflatten(0, (-1, d))

        # p_proposal of Eq. 17, the first factor of Eq. 16 with p_context, which the loop over time adds
        evidence = torch.cat([cells.flatten(2).transpose(1, 2), what, window], dim=-1)
        prob = torch.sigmoid(self.head_pres(evidence)).squeeze(-1)

        return Proposals(
            q_where,
            Gaussian(*(x.unflatten(0, (-1, d)) for x in q_what)),
            what,
            place,
            prob,
            hidden.unflatten(0, (-1, d)),
        )


def scope_in_windows(
    scope: Float[Tensor, "B H W"], rows: Float[Tensor, "B D H"], columns: Float[Tensor, "B D W"]
) -> Float[Tensor, "B D"]:
    """Share of each cell's window that the propagated objects leave unexplained, in [0, 1] (discovery's prior).

    A window too small to hold a pixel centre is fully open, as it is to p_context.
    """
    inside = ((rows @ scope) * columns).sum(-1)
    whole = rows.sum(-1) * columns.sum(-1)
    return torch.where(whole > 0, inside / whole.clamp_min(1e-6), torch.ones_like(whole))


def context_probability(scope: Float[Tensor, "B H W"], claims: Float[Tensor, "B D H W"]) -> Float[Tensor, "B D"]:
    """p_context: share of each proposal's mask that is not yet explained, in [0, 1] (Eq. 18)."""
    taken = 1 - scope.flatten(1)
    explained, whole = (claims.flatten(2) @ torch.stack([taken, torch.ones_like(taken)], dim=-1)).unbind(-1)
    tiny = 1e-6  # a window too small to hold a pixel centre claims nothing: its context is fully open
    # As one minus the explained share: with nothing propagated it is exactly one, whatever the rounding of the sums.
    return (1 - explained / (whole + tiny)).clamp_min(0)

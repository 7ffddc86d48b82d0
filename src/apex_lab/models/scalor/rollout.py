"""The loop over time: propagation, discovery, which objects are kept (scalor.md section 2, steps 1 to 3 and 7)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.scalor.composition import clamped, paster_of
from apex_lab.models.scalor.discovery import Discovery, Proposals, Rejection, room
from apex_lab.models.scalor.encoder import LSTMState
from apex_lab.models.scalor.glimpses import GlimpseDecoder, GlimpseEncoder
from apex_lab.models.scalor.latents import Sampler, full_precision
from apex_lab.models.scalor.propagation import Propagated, Propagation
from apex_lab.models.scalor.recompute import Recompute
from apex_lab.models.scalor.slots import FIRST_ID, Objects, Slots, admitted, carry, keep, pack, strongest
from apex_lab.models.scalor.windows import SizeRule
from apex_lab.nn.celu_stack import fast_on
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.precision import full
from apex_lab.nn.slots import gather_slots, leading, padded
from apex_lab.nn.spatial_transformer import window_of
from apex_lab.scene import ABSENT, Noise, Schedule


class State(NamedTuple):
    """What the next chunk of the same videos starts from.

    memory: of the ConvLSTM. slots: objects. background: z_bg of the last frame, and the state of its prior's GRU.
    """

    memory: LSTMState
    slots: Slots
    background: tuple[Tensor, Tensor]


class Shown(NamedTuple):
    """Cells of a frame with a presence above zero, as they are rendered.

    cells (B, n): their indices; those that are valid come first, and n is at least 1. valid (B, n). drawn
    (B, n, 4, g, g): o and alpha, with gradients.
    """

    cells: Int[Tensor, "B n"]
    valid: Bool[Tensor, "B n"]
    drawn: Float[Tensor, "B n 4 g g"]

    def alpha_of(self, count: int) -> Float[Tensor, "B count 1 g g"]:
        """Alpha of all `count` cells without gradient, zero where they are not shown."""
        alpha = self.drawn.detach()[:, :, 3:] * self.valid[..., None, None, None]
        cells = self.cells[..., None, None, None].expand_as(alpha)
        return alpha.new_zeros(len(alpha), count, *alpha.shape[2:]).scatter_add_(1, cells, alpha)


class Step(NamedTuple):
    """One frame as the loop leaves it; P propagated slots, D discovery cells.

    propagated: None in the first frame of a video, where no slot holds anything.
    alive (B, P): the slot came into the frame with an object.
    proposals: before rejection.
    accepted (B, D): not rejected. found (B, D): z_pres after rejection and training's cap.
    drawn (B, n, C, g, g) or None, drawn_found (B, D, C, g, g): alpha, of the leading n slots and of the cells. Where
        gradients are off, o (RGB) before it; where `shown` is given, `drawn` has o too, and gradients.
    shown: None where it is drawn later what is rendered.
    source, kept, ids (B, P): what the slots hold after the frame, as in `slots.Kept`.
    """

    propagated: Propagated | None
    alive: Bool[Tensor, "B P"]
    proposals: Proposals
    accepted: Bool[Tensor, "B D"]
    found: Float[Tensor, "B D"]
    drawn: Float[Tensor, "B n C g g"] | None
    drawn_found: Float[Tensor, "B D C g g"]
    shown: Shown | None
    source: Int[Tensor, "B P"]
    kept: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]


class ObjectNetworks(nn.Module):
    """All networks that know of objects, and the loop over frames that they run in.

    Args:
        image_size: H = W in pixels.
        grid: G.
        glimpse_size: g, side of glimpses in pixels.
        what: length of z_what.
        size: rule of a box's size.
        max_objects, evaluation_objects: P in training and in evaluation.
        track: a discovery with a presence above this is carried on.
        stop: as in `Propagation`.
        deep_heads: heads with a hidden layer (images of 128 px).
        recompute: of the glimpse decoder and the composition. recompute_looks: of the glimpse encoder.
    """

    def __init__(
        self,
        image_size: int,
        grid: int,
        glimpse_size: int,
        what: int,
        size: SizeRule,
        max_objects: int,
        evaluation_objects: int,
        track: float,
        stop: float,
        deep_heads: bool,
        recompute: Recompute,
        recompute_looks: Recompute,
    ) -> None:
        super().__init__()
        self.image_size, self.what, self.track = image_size, what, track
        self.max_objects, self.evaluation_objects = max_objects, evaluation_objects
        self.recompute, self.recompute_looks = recompute, recompute_looks
        self.glimpse_encoder = GlimpseEncoder(glimpse_size, what)
        self.glimpse_decoder = GlimpseDecoder(glimpse_size, what, deep_heads)
        self.discovery = Discovery(image_size, grid, size, deep_heads)
        self.propagation = Propagation(grid, what, size, stop)
        self.rejection = Rejection()

    def forward(
        self,
        video: Float[Tensor, "B T 3 H W"],
        features: Float[Tensor, "B T 64 G G"],
        slots: Slots | None,
        noise: Noise | None,
        schedule: Schedule,
    ) -> tuple[list[Step], Slots]:
        """Frames, and the slots after the last one.

        Only what the next frame depends on happens here; the frames are rendered later, all at once (`render`).

        Args:
            video: RGB in [0, 1].
            features: e_t.
            slots: after the frame before the first; None at the start of a video.
            noise: None takes means in place of samples.
            schedule: as in `Scalor.schedule_ranges`.
        """
        steps = []
        for t, (image, feature) in enumerate(zip(video.unbind(1), features.unbind(1), strict=True)):
            sampler = Sampler(None if noise is None else noise.at(t), schedule["temperature"])
            propagated, drawn, explained = self._propagate(image, feature, slots, sampler)
            slots = slots or self._no_objects(video)
            proposals, drawn_found, accepted = self._propose(image, feature, explained, sampler)
            found = proposals.presence.squeeze(-1) * accepted
            if self.training:
                found = found * strongest(found.detach(), room(slots.valid, self.max_objects))
            shown = self._shown(proposals, found) if self._draws_at_once(video) else None
            if drawn_found is None:
                assert shown is not None
                drawn_found = shown.alpha_of(found.shape[1])
            source, after = self._keep(slots, propagated, proposals, found, schedule)
            steps.append(
                Step(
                    propagated,
                    slots.valid,
                    proposals,
                    accepted,
                    found,
                    drawn,
                    drawn_found,
                    shown,
                    source,
                    after.valid,
                    after.ids,
                )
            )
            slots = after
        assert slots is not None
        return steps, slots

    def _no_objects(self, video: Tensor) -> Slots:
        b, count = len(video), self.max_objects if self.training else self.evaluation_objects
        hidden, hidden_prior = self.propagation.tracker.hidden_size, self.propagation.prior.rnn.hidden_size
        what, one = video.new_zeros(b, count, self.what), video.new_zeros(b, count, 1)
        return Slots(
            Objects.found(what, video.new_zeros(b, count, 4), one, one, hidden, hidden_prior),
            torch.zeros(b, count, dtype=torch.bool, device=video.device),
            torch.full((b, count), ABSENT, device=video.device),
            torch.full((b,), FIRST_ID, device=video.device),
        )

    def _propagate(
        self, image: Tensor, feature: Tensor, slots: Slots | None, sampler: Sampler
    ) -> tuple[Propagated | None, Tensor | None, Tensor | None]:
        """Objects of the frame before in this frame, drawn, and the sum of their masks (B, H, W), without gradient."""
        if slots is None:
            return None, None, None
        propagated = self.propagation(
            slots.objects, slots.valid, feature, image, self.glimpse_encoder, sampler, self.recompute_looks
        )
        objects = propagated.objects
        some = leading(slots.valid)
        what = objects.what[:, :some]
        drawn = self._decoded(what) if self._draws_at_once(what) else self._drawn(what)
        with torch.no_grad(), full_precision(image):
            masks = full(drawn[:, :, -1]) * objects.presence[:, :some, :, None]
            windows = window_of(objects.where[:, :some])
            explained = paster_of(windows, masks.shape[-1], self.image_size).total(masks)
        return propagated, drawn, explained

    def _propose(
        self, image: Tensor, feature: Tensor, explained: Tensor | None, sampler: Sampler
    ) -> tuple[Proposals, Tensor | None, Tensor]:
        """Proposals, drawn, and which of them propagated objects do not explain already.

        Not drawn where the loop draws those with a presence once more, with gradients.
        """
        mask = clamped(torch.zeros_like(image[:, 0]) if explained is None else explained)
        proposals = self.discovery(feature, mask, image, self.glimpse_encoder, sampler, self.recompute_looks)
        windows = window_of(proposals.where).detach()
        if self._draws_at_once(image):
            return proposals, None, self._accepted(proposals.what, windows, None if explained is None else mask)
        drawn = self._drawn(proposals.what)
        if explained is None:
            return proposals, drawn, torch.ones_like(proposals.logit, dtype=torch.bool)
        return proposals, drawn, self.rejection.kept(drawn[:, :, -1], windows, mask)

    @torch.no_grad()
    def _accepted(self, what: Tensor, windows: Tensor, explained: Tensor | None) -> Bool[Tensor, "B D"]:
        """Proposals that are not rejected; only those are drawn that reach explained pixels."""
        accepted = torch.ones(what.shape[:2], dtype=torch.bool, device=what.device)
        if explained is None:
            return accepted
        cells, valid = pack(self.rejection.in_question(windows, explained, self.glimpse_decoder.size), what.shape[1])
        some = leading(valid)
        cells, valid = cells[:, :some], valid[:, :some]
        alpha = self.glimpse_decoder(gather_slots(what, cells), alpha_only=True)[:, :, -1]
        rejected = valid & ~self.rejection.kept(alpha, gather_slots(windows, cells), explained)
        return torch.zeros_like(accepted, dtype=torch.long).scatter_add_(1, cells, rejected.long()) == 0

    def _draws_at_once(self, like: Tensor) -> bool:
        """Whether the loop draws with gradients what it knows to be rendered; elsewhere shapes would depend on data."""
        return torch.is_grad_enabled() and fast_on(like)

    def _drawn(self, what: Float[Tensor, "B K Z"]) -> Float[Tensor, "B K C g g"]:
        """Masks for the decisions of the loop, which have no gradient; colours too if these drawings are rendered."""
        alpha_only = torch.is_grad_enabled()
        with torch.no_grad():
            return self.glimpse_decoder(what, alpha_only)

    def _decoded(self, what: Float[Tensor, "B K Z"]) -> Float[Tensor, "B K 4 g g"]:
        """Drawings with gradients."""
        return self.glimpse_decoder(what, keep=not self.recompute_looks.active)

    def _shown(self, proposals: Proposals, found: Float[Tensor, "B D"]) -> Shown:
        """Drawings of the cells with a presence above zero."""
        cells, valid = pack(found.detach() > 0, found.shape[1])
        some = leading(valid)
        cells, valid = cells[:, :some], valid[:, :some]
        return Shown(cells, valid, self._decoded(gather_slots(proposals.what, cells)))

    def _keep(
        self, slots: Slots, propagated: Propagated | None, proposals: Proposals, found: Tensor, schedule: Schedule
    ) -> tuple[Int[Tensor, "B P"], Slots]:
        """Candidates that the slots hold after this frame, and the slots."""
        old = slots.objects if propagated is None else propagated.objects  # in the first frame all slots are empty
        stays, arrives = old.presence.squeeze(-1) > 0, found > self.track
        if not self.training:  # in training, the cap on discoveries leaves none without a slot
            arrives = admitted(arrives, found, room(stays, stays.shape[1]))
        kept = keep(stays, arrives, slots.ids, slots.next_id)
        new = Objects.found(
            proposals.what,
            proposals.where,
            proposals.depth,
            found[..., None],
            old.tracker.shape[-1],
            old.prior_h.shape[-1],
        )
        objects = carry((old, new), kept, schedule["slot_gradient"])
        return kept.source, Slots(objects, kept.valid, kept.ids, kept.next_id)


def joined_candidates(step: Step, propagated: Tensor | None, found: Tensor) -> Tensor:
    """(B, n, ...) of the leading slots and (B, D, ...) -> (B, P + D, ...); zeros for the P slots of a first frame."""
    slots = step.alive.shape[1]
    if propagated is None:
        propagated = found.new_zeros(len(found), slots, *found.shape[2:])
    return torch.cat([padded(propagated, slots), found], dim=1)


def gaussians(frames: list[Gaussian]) -> Gaussian:
    """Gaussians of frames (B, ...) -> of the video (B, T, ...)."""
    return Gaussian(torch.stack([q.mean for q in frames], dim=1), torch.stack([q.std for q in frames], dim=1))

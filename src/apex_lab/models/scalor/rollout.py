"""The loop over time: propagation, discovery, which objects are kept (scalor.md section 2, steps 1 to 3 and 7)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.scalor.composition import Layers, clamped, layers_of
from apex_lab.models.scalor.discovery import Discovery, Proposals, Rejection, room
from apex_lab.models.scalor.encoder import LSTMState
from apex_lab.models.scalor.glimpses import GlimpseDecoder, GlimpseEncoder
from apex_lab.models.scalor.latents import Sampler
from apex_lab.models.scalor.propagation import Propagated, Propagation
from apex_lab.models.scalor.recompute import Recompute
from apex_lab.models.scalor.slots import FIRST_ID, Objects, Slots, carry, keep, strongest
from apex_lab.models.scalor.windows import SizeRule, window_of
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import ABSENT, Noise, Schedule

CURRICULUM_ALPHA = 0.9
"""Mask of every proposal under the alpha curriculum, when the foreground's mask is computed."""


class State(NamedTuple):
    """What the next chunk of the same videos starts from.

    memory: of the ConvLSTM. slots: objects. background: z_bg of the last frame, and the state of its prior's GRU.
    """

    memory: LSTMState
    slots: Slots
    background: tuple[Tensor, Tensor]


class Step(NamedTuple):
    """One frame as the loop leaves it; P propagated slots, D discovery cells.

    propagated: None in the first frame of a video, where no slot holds anything.
    alive (B, P): the slot came into the frame with an object.
    proposals: before rejection.
    accepted (B, D): not rejected. found (B, D): z_pres after rejection and training's cap.
    drawn (B, P, 4, g, g) or None, drawn_found (B, D, 4, g, g): o and alpha.
    source, kept, ids (B, P): what the slots hold after the frame, as in `slots.Kept`.
    """

    propagated: Propagated | None
    alive: Bool[Tensor, "B P"]
    proposals: Proposals
    accepted: Bool[Tensor, "B D"]
    found: Float[Tensor, "B D"]
    drawn: Float[Tensor, "B P 4 g g"] | None
    drawn_found: Float[Tensor, "B D 4 g g"]
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
    ) -> tuple[list[Step], list[Layers], Slots]:
        """Frames, their rendered layers, and the slots after the last frame.

        Args:
            video: RGB in [0, 1].
            features: e_t.
            slots: after the frame before the first; None at the start of a video.
            noise: None takes means in place of samples.
            schedule: as in `Scalor.schedule_ranges`.
        """
        steps, rendered = [], []
        for t, (image, feature) in enumerate(zip(video.unbind(1), features.unbind(1), strict=True)):
            sampler = Sampler(None if noise is None else noise.at(t), schedule["temperature"])
            propagated, drawn, layers = self._propagate(image, feature, slots, sampler)
            slots = slots or self._no_objects(video)
            proposals, drawn_found, accepted = self._propose(image, feature, layers, sampler)
            found = proposals.presence.squeeze(-1) * accepted
            if self.training:
                found = found * strongest(found.detach(), room(slots.valid, self.max_objects))
            new = self._layers(drawn_found, found, proposals.depth, proposals.where)
            every = torch.full_like(new.alpha, CURRICULUM_ALPHA * found.shape[1])
            new = new._replace(alpha=torch.where(schedule["alpha_curriculum"] > 0.5, every, new.alpha))
            rendered.append(new if layers is None else layers.plus(new))

            after, step_slots = self._keep(slots, propagated, proposals, found, schedule)
            steps.append(
                Step(
                    propagated,
                    slots.valid,
                    proposals,
                    accepted,
                    found,
                    drawn,
                    drawn_found,
                    after,
                    step_slots.valid,
                    step_slots.ids,
                )
            )
            slots = step_slots
        assert slots is not None
        return steps, rendered, slots

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
    ) -> tuple[Propagated | None, Tensor | None, Layers | None]:
        """Objects of the frame before in this frame, drawn and rendered."""
        if slots is None:
            return None, None, None
        propagated = self.propagation(
            slots.objects, slots.valid, feature, image, self.glimpse_encoder, sampler, self.recompute_looks
        )
        objects = propagated.objects
        drawn = self.recompute(self.glimpse_decoder, objects.what)
        return propagated, drawn, self._layers(drawn, objects.presence.squeeze(-1), objects.depth, objects.where)

    def _propose(
        self, image: Tensor, feature: Tensor, layers: Layers | None, sampler: Sampler
    ) -> tuple[Proposals, Tensor, Tensor]:
        """Proposals, drawn, and which of them propagated objects do not explain already."""
        explained = clamped(torch.zeros_like(image[:, 0]) if layers is None else layers.alpha.detach())
        proposals = self.discovery(feature, explained, image, self.glimpse_encoder, sampler, self.recompute_looks)
        drawn = self.recompute(self.glimpse_decoder, proposals.what)
        if layers is None:
            return proposals, drawn, torch.ones_like(proposals.logit, dtype=torch.bool)
        masks, windows = drawn[:, :, 3].detach(), window_of(proposals.where).detach()
        return proposals, drawn, self.rejection.kept(masks, windows, explained)

    def _layers(self, drawn: Tensor, presence: Tensor, depth: Tensor, where: Tensor) -> Layers:
        return self.recompute(layers_of, drawn, presence, depth.squeeze(-1), window_of(where), self.image_size)

    def _keep(
        self, slots: Slots, propagated: Propagated | None, proposals: Proposals, found: Tensor, schedule: Schedule
    ) -> tuple[Int[Tensor, "B P"], Slots]:
        """Candidates that the slots hold after this frame, and the slots."""
        old = slots.objects if propagated is None else propagated.objects  # in the first frame all slots are empty
        kept = keep(old.presence.squeeze(-1) > 0, found > self.track, slots.ids, slots.next_id)
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


def gaussians(frames: list[Gaussian]) -> Gaussian:
    """Gaussians of frames (B, ...) -> of the video (B, T, ...)."""
    return Gaussian(torch.stack([q.mean for q in frames], dim=1), torch.stack([q.std for q in frames], dim=1))

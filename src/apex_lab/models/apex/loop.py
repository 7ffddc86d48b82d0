"""The loop over time: propagation, presence of discoveries, filtering (apex.md, "Inference side")."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.profiler import record_function

from apex_lab.models.apex.foresight import Plan
from apex_lab.models.apex.objects import (
    Objects,
    Posterior,
    context_probability,
    sample_presence,
    scope_in_windows,
    spread,
)
from apex_lab.models.apex.rollout import Claimed, Claims, FollowedMasks, Frame, Memory, Step, stack_steps
from apex_lab.models.apex.slots import carry
from apex_lab.nn.slots import NoiseOfSlots, any_of, filled, gather_slots, inverse_of
from apex_lab.nn.splitting import joined, part_size
from apex_lab.scene import Noise, Schedule

if TYPE_CHECKING:
    from apex_lab.models.apex.model import Apex


def roll_out(
    model: Apex,
    frames: list[Frame],
    claims: list[Claims | None],
    memory: Memory,
    schedule: Schedule,
    noise: Noise | None,
) -> tuple[Step, Memory]:
    """The part that depends on the frame before, frame by frame (Eq. 2, which is Eq. 13).

    Within a frame (Eq. 14): propagated objects, then discovered ones; the background, whose posterior needs the
    masks of both, is left to `Apex._explain`.
    """
    state, valid, ids, next_id, carried_on = memory
    steps: list[Step] = []
    masks: list[FollowedMasks | None] = []
    for t, (frame, claimed) in enumerate(zip(frames, claims, strict=True)):
        there, followed = any_of(valid), None
        # in the last frame if in none before, so that all weights have gradients
        if there or (t == len(frames) - 1 and not any(masks)):
            with record_function("propagation"):
                followed = _followed(model, state, valid, frame, schedule, noise, masks_now=claimed is not None)
        if followed is None:
            before, posterior = model.propagation.nothing(state, noise)
        else:
            before, posterior = followed.objects, followed.posterior
        masks.append(None if followed is None else followed.masks)

        open_ = may_discover(carried_on, schedule, noise).to(frame.prob.dtype)
        context = unexplained = torch.ones_like(frame.prob)  # where nothing is propagated, everything is open
        if there and followed is not None and claimed is not None:
            with record_function("discovery"):
                context, unexplained = _left_by(model, followed, claimed, context)
        prob = frame.prob * context * open_  # Eq. 17
        # Eq. 6: the prior of a discovery's presence, given the propagated objects
        prior = schedule["discovery_presence"] * unexplained * open_
        pres = sample_presence(prob, schedule["temperature"], noise) * open_
        top = prob.detach().topk(model.render_top, dim=1).indices
        found = rendered(frame, pres, top, model.hidden)

        both = torch.cat([before.packed(), found.packed()], dim=1)
        candidates = before.unpacked(both)
        exists = torch.cat([valid, torch.ones_like(top, dtype=torch.bool)], dim=1)
        kept = carry(candidates.presence, exists, ids, next_id, model.keep_threshold)
        steps.append(
            Step(
                what=candidates.what,
                place=candidates.place,
                alpha=gather_slots(frame.alpha, top),
                presence=candidates.presence,
                valid=exists & (candidates.presence > 0),
                alive=valid,
                propagated=posterior,
                discovery_prob=prob,
                discovery_prior=prior,
                discovery_pres=pres,
                source=kept.source,
                carried=kept.valid,
                ids=kept.ids,
            )
        )
        state, ids, next_id = before.unpacked(gather_slots(both, kept.source)), kept.ids, kept.next_id
        carried_on = carries_on(carried_on, schedule, noise)
        valid = kept.valid & carried_on
    return _video(model, steps, masks), Memory(state, valid, ids, next_id, carried_on)


class _Followed(NamedTuple):
    """Objects that were propagated into a frame.

    objects, posterior: of all P slots. few: the objects of those that hold one, which `masks` are of.
    """

    objects: Objects
    posterior: Posterior
    few: Objects
    masks: FollowedMasks


def _followed(
    model: Apex, state: Objects, valid: Tensor, frame: Frame, schedule: Schedule, noise: Noise | None, masks_now: bool
) -> _Followed:
    """The objects of a frame in the next one; their mask logits at once or later, with those of other frames."""
    slots = filled(valid)
    few, posterior = _propagated(model, state, valid, slots, frame, schedule, noise)
    objects = few
    if slots is not None:
        objects, posterior = spread(few, posterior, slots, valid)
    masks = FollowedMasks(few.what, model.alpha(few.what) if masks_now else None, slots)
    return _Followed(objects, posterior, few, masks)


def _left_by(
    model: Apex, followed: _Followed, claimed: Claims, everything: Float[Tensor, "B D"]
) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
    """What propagated objects leave to discovery's cells, of `everything`: of their masks and of their windows."""
    few, alpha = followed.few, followed.masks.alpha
    assert alpha is not None
    paster = model.paster(few.place, alpha.shape[-1])
    scope = claimed.of_videos(1 - model.masks.foreground(alpha, few.presence, paster))
    context = claimed.put(everything, context_probability(scope, claimed.masks))
    return context, claimed.put(everything, scope_in_windows(scope, claimed.rows, claimed.columns))


def _propagated(
    model: Apex,
    state: Objects,
    valid: Tensor,
    slots: Tensor | None,
    frame: Frame,
    schedule: Schedule,
    noise: Noise | None,
) -> tuple[Objects, Posterior]:
    """The objects in some slots (B, n), None for all, in the next frame."""
    total = valid.shape[1]
    if slots is not None:
        state, valid = state.unpacked(gather_slots(state.packed(), slots)), valid.gather(1, slots)
        noise = None if noise is None else NoiseOfSlots(noise, slots, total)
    return model.propagation(
        state,
        model.glimpses,
        model.appearance,
        frame.look_at,
        frame.follow_in,
        valid,
        schedule["temperature"],
        noise,
    )


def _video(model: Apex, steps: list[Step], masks: list[FollowedMasks | None]) -> Step:
    """Frames -> video, with what needs no frame before: priors of propagated objects and their mask logits."""
    video = stack_steps(steps)
    assert isinstance(video.propagated, Posterior)
    beliefs = model.propagation.beliefs(video.propagated)
    alpha = torch.cat([_alphas(model, masks, video.alpha, video.alive.shape[-1]), video.alpha], dim=2)
    return video._replace(propagated=beliefs, alpha=alpha)


def _alphas(
    model: Apex, frames: list[FollowedMasks | None], like: Float[Tensor, "B T N g g"], total: int
) -> Float[Tensor, "B T P g g"]:
    """Mask logits of all slots in all frames; those that the loop could do without are made here, at once."""
    waiting = [frame.what for frame in frames if frame is not None and frame.alpha is None]
    counts = [what.shape[1] for what in waiting]
    made = iter(model.alpha(torch.cat(waiting, dim=1)).split(counts, dim=1) if waiting else ())
    found = []
    for frame in frames:
        if frame is None:
            found.append(like.new_zeros(len(like), total, *like.shape[3:]))
            continue
        alpha = next(made) if frame.alpha is None else frame.alpha
        found.append(alpha if frame.slots is None else gather_slots(alpha, inverse_of(frame.slots, total)))
    return torch.stack(found, dim=1)


def claims_of(
    model: Apex, alphas: Float[Tensor, "F D g g"], place: Float[Tensor, "F D 4"], plan: Plan, shape: tuple[int, int]
) -> list[Claims | None]:
    """What the cells of each frame would cover on their own, where that matters: no frame waits for another."""
    which = None if plan.hidden is None else Claimed.of(plan.hidden, plan.opened)
    if which is not None:
        alphas, place = (x.index_select(0, which.rows) for x in (alphas, place))
    size = part_size(max(1, len(alphas)), alphas.shape[1] * model.image_size**2, place)
    found = []
    for alpha, where in zip(*(x.split(size) for x in (alphas, place)), strict=True):
        paster = model.paster(where, alpha.shape[-1])
        found.append((model.masks.claim(alpha, paster), *paster.inside()))
    claims = [joined(parts) for parts in zip(*found, strict=True)]
    if which is None:
        return [Claims(*values) for values in zip(*(x.unflatten(0, shape).unbind(1) for x in claims), strict=True)]
    return which.frames(claims)


def carries_on(before: Tensor, schedule: Schedule, noise: Noise | None) -> Tensor:
    """Which videos carry their objects into the next frame, (B, 1); all in evaluation.

    A curriculum over sequence length without another shape: with probability 1 - carry a video starts afresh, so
    at 0 all frames are images that discovery explains alone, at 1 videos are whole. Propagation learns from
    objects that exist; carried false ones of the first steps only teach it that objects should vanish.
    """
    if noise is None:
        return torch.ones_like(before)
    return noise.uniform(before.float()) < schedule["carry"]


def may_discover(carried_on: Tensor, schedule: Schedule, noise: Noise | None) -> Tensor:
    """Which videos may discover objects in this frame, (B, 1); all in evaluation.

    Rediscovering everything in every frame explains a video as well as tracking does, for the price of a few KL
    terms, and in early trials the presence of propagated objects died and did not revive. So in training a video
    that carries objects is now and then left to them alone (a conjecture; measured in docs/apex.md).
    """
    if noise is None:
        return torch.ones_like(carried_on)
    return ~carried_on | (noise.uniform(carried_on.float()) < schedule["discover"])


def rendered(cells: Frame, pres: Tensor, top: Tensor, hidden: int) -> Objects:
    """The rendered discoveries of a frame as objects; their other recurrent states start at zero."""
    nothing = pres.new_zeros(*top.shape, hidden)
    return Objects(
        gather_slots(cells.what, top),
        gather_slots(cells.place, top),
        gather_slots(pres, top),
        nothing,
        gather_slots(cells.hidden_what, top),
        nothing,
        nothing,
    )

"""Rendering of all frames after the loop over time (scalor.md section 2, step 4, and section 8)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.models.scalor.composition import Layers, layers_of
from apex_lab.models.scalor.rollout import ObjectNetworks, Step, joined_candidates
from apex_lab.models.scalor.slots import pack
from apex_lab.nn.slots import gather_slots, leading
from apex_lab.nn.spatial_transformer import window_of
from apex_lab.scene import Schedule

CURRICULUM_ALPHA = 0.9
"""Mask of every proposal under the alpha curriculum, when the foreground's mask is computed."""


def render(networks: ObjectNetworks, steps: list[Step], schedule: Schedule) -> Layers:
    """All frames of a video as they are rendered, (B, T, ...) in place of (N, ...)."""
    curriculum = schedule["alpha_curriculum"] > 0.5
    if steps[0].shown is not None:
        frames = [_shown(step, curriculum, networks.image_size) for step in steps]
    else:
        frames = _later(networks, steps, curriculum)
    layers = Layers(*(torch.stack(sums, dim=1) for sums in zip(*frames, strict=True)))
    every = torch.where(curriculum, CURRICULUM_ALPHA * steps[0].found.shape[1], 0.0)
    return layers._replace(alpha=layers.alpha + every)


def _shown(step: Step, curriculum: Tensor, size: int) -> Layers:
    """A frame whose candidates have been drawn with gradients."""
    assert step.shown is not None
    values = gather_slots(_found(step), step.shown.cells)
    counted = torch.where(curriculum, 0.0, torch.ones_like(values[..., 0]))
    layers = _layers(step.shown.drawn, values, counted, size, step.shown.valid)
    if step.propagated is None or step.drawn is None:
        return layers
    values = _propagated(step)[:, : step.drawn.shape[1]]
    others = _layers(step.drawn, values, torch.ones_like(values[..., 0]), size)
    return Layers(*(a + b for a, b in zip(others, layers, strict=True)))


def _later(networks: ObjectNetworks, steps: list[Step], curriculum: Tensor) -> list[Layers]:
    """Frames whose candidates are to be drawn with gradients, or are all drawn already where gradients are off.

    In training at most P of the P + D candidates of a frame have a presence above zero (the cap on discoveries sees to
    that), so only these are drawn with gradients.
    """
    values = torch.stack([_candidates(step) for step in steps], dim=1)
    slots, count = steps[0].alive.shape[1], values.shape[2]
    index = torch.arange(count, device=values.device).expand(values.shape[:3])
    most = [count] * len(steps)
    if networks.training and torch.is_grad_enabled():
        present = values[..., 0].detach().flatten(0, 1) > 0
        index, valid = (x.unflatten(0, values.shape[:2]) for x in pack(present, min(networks.max_objects, count)))
        presence, others = gather_slots(values, index, dim=2).split([1, values.shape[-1] - 1], dim=-1)
        values = torch.cat([presence * valid[..., None], others], dim=-1)
        most = [leading(frame) for frame in valid.unbind(1)]
    counted = torch.where(curriculum & (index >= slots), 0.0, 1.0)

    def layers(drawn: Tensor | None, frame: Tensor, weights: Tensor) -> Layers:
        if drawn is None:
            drawn = networks.glimpse_decoder(frame[..., -networks.what :])
        return _layers(drawn, frame, weights, networks.image_size)

    full = steps[0].drawn_found.shape[2] > 1
    drawn = [joined_candidates(step, step.drawn, step.drawn_found) if full else None for step in steps]
    frames = zip(drawn, values.unbind(1), counted.unbind(1), most, strict=True)
    return [networks.recompute(layers, picture, x[:, :n], weights[:, :n]) for picture, x, weights, n in frames]


def _layers(drawn: Tensor, values: Tensor, counted: Tensor, size: int, valid: Tensor | None = None) -> Layers:
    presence, depth, where = (x.squeeze(-1) for x in values[..., :6].split([1, 1, 4], dim=-1))
    return layers_of(drawn, presence if valid is None else presence * valid, depth, window_of(where), counted, size)


def _found(step: Step) -> Float[Tensor, "B D six_Z"]:
    """Presence, depth, place and appearance of the cells side by side."""
    cells = step.proposals
    return torch.cat([step.found[..., None], cells.depth, cells.where, cells.what], dim=-1)


def _propagated(step: Step) -> Float[Tensor, "B P six_Z"]:
    assert step.propagated is not None
    objects = step.propagated.objects
    return torch.cat([objects.presence, objects.depth, objects.where, objects.what], dim=-1)


def _candidates(step: Step) -> Float[Tensor, "B K six_Z"]:
    return joined_candidates(step, None if step.propagated is None else _propagated(step), _found(step))

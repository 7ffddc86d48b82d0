"""APEX's result for a video: its rendered frames, and the `Scene` of the objects that are carried on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from apex_lab.models.apex.parts import Part, in_order
from apex_lab.models.apex.rollout import State, Step
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.slots import gather_slots
from apex_lab.scene import BACKGROUND_ID, Scene


class Drawn(NamedTuple):
    """Inputs of rendering N frames: fields of `Step` of n components."""

    alpha: Float[Tensor, "N n g g"]
    presence: Float[Tensor, "N n"]
    valid: Bool[Tensor, "N n"]
    place: Float[Tensor, "N n 4"]
    what: Float[Tensor, "N n Z"]


class Picture(NamedTuple):
    """N rendered frames; of a whole video with dimensions (B, T) in place of N.

    objects (N, P, H, W): masks of what the slots hold after filtering, arbitrary where a slot holds nothing.
    foreground (N, H, W): m_fg; reconstruction (N, 3, H, W): RGB in [0, 1].
    log_likelihood, mask_entropy (N,): nats; loose_windows (N,): see `objective.loose_windows`.
    backdrop (N, 3, H, W): the background's image; means (N, P, 3, H, W): the objects' images or None.
    """

    objects: Tensor
    foreground: Tensor
    reconstruction: Tensor
    log_likelihood: Tensor
    mask_entropy: Tensor
    loose_windows: Tensor
    backdrop: Tensor
    means: Tensor | None


def video_of(parts: Sequence[Part], pictures: Sequence[Picture], batch: int) -> Picture:
    """Rendered parts of `batch` videos -> dimensions (B, T) in place of N."""

    def whole(name: str) -> Tensor:
        return in_order(parts, [getattr(picture, name) for picture in pictures]).unflatten(0, (batch, -1))

    return Picture(
        whole("objects"),
        whole("foreground"),
        whole("reconstruction"),
        whole("log_likelihood"),
        whole("mask_entropy"),
        whole("loose_windows"),
        whole("backdrop"),
        None if pictures[0].means is None else whole("means"),
    )


def _shares(objects: Float[Tensor, "B T P H W"], at_most: int = 5) -> list[Tensor]:
    """Mean share of pixels of the largest, second largest, ... object of a frame."""
    ranked = objects.mean((-2, -1)).sort(dim=-1, descending=True).values.mean((0, 1))
    return list(ranked[:at_most].unbind())


def scene_of(
    steps: Step, picture: Picture, terms: dict[str, Tensor], detail: bool = True, state: State | None = None
) -> Scene:
    """The P objects carried on and the background, last. Pixels of objects that were dropped become background."""
    b, t, slots = steps.source.shape
    flat = steps.source.flatten(0, 1)

    def held(values: Tensor) -> Tensor:
        return gather_slots(values.flatten(0, 1), flat).unflatten(0, (b, t))

    carried = steps.carried
    objects = picture.objects * carried[..., None, None]
    presence = held(steps.presence) * carried
    window = window_of(held(steps.place)).masked_fill(~carried[..., None], torch.nan)
    what = held(steps.what) * carried[..., None]
    live = carried.sum(-1).clamp_min(1)
    kept = (steps.alive * steps.propagated.q_pres).sum() / steps.alive.sum().clamp_min(1)
    means = None if picture.means is None else picture.means * carried[..., None, None, None]
    return Scene(
        masks=torch.cat([objects, (1 - objects.sum(2, keepdim=True)).clamp_min(0)], dim=2),
        background=torch.arange(slots + 1, device=carried.device) == slots,
        ids=torch.cat([steps.ids, torch.full_like(steps.ids[..., :1], BACKGROUND_ID)], dim=-1),
        presence=torch.cat([presence, torch.ones_like(presence[..., :1])], dim=-1),
        appearance=torch.cat([what, torch.zeros_like(what[..., :1, :])], dim=2),
        reconstruction=picture.reconstruction,
        terms=terms,
        windows=torch.cat([window, torch.full_like(window[..., :1, :], torch.nan)], dim=2) if detail else None,
        means=None if means is None else torch.cat([means, picture.backdrop[:, :, None]], dim=2),
        diagnostics={
            **{f"share_{i}": share for i, share in enumerate(_shares(objects))},
            "live_objects": carried.float().sum(-1).mean(),
            "foreground": picture.foreground.mean(),
            "window_size": (window[..., :2].mean(-1).nan_to_num().sum(-1) / live).mean(),
            "discovery_prob": steps.discovery_prob.mean(),
            "propagated_prob": kept,
            "propagated_share": (carried & (steps.source < slots)).sum() / carried.sum().clamp_min(1),
        },
        state=state,
    )

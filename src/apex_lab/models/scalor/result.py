"""From the frames of a video to its `Scene` (scalor.md section 14)."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from apex_lab.models.scalor.composition import Layers, paster_of
from apex_lab.models.scalor.latents import GUARD
from apex_lab.models.scalor.rollout import Step, joined_candidates
from apex_lab.models.scalor.windows import window_of
from apex_lab.nn.precision import full
from apex_lab.nn.splitting import part_size

Readout = Literal["rendering", "overlay"]

BACKGROUND_ID = 0

FAINT = 0.3
"""The original's overlay is shown where the foreground's mask is above this."""


def held(step: Step, propagated: Tensor | None, found: Tensor) -> Tensor:
    """Values of the candidates that the P slots hold after the frame, (B, P, ...); zero where they hold nothing."""
    values = joined_candidates(step, propagated, found)
    kept = step.kept.reshape(*step.kept.shape, *([1] * (values.dim() - 2)))
    source = step.source.reshape(*step.source.shape, *([1] * (values.dim() - 2)))
    return values.gather(1, source.expand(-1, -1, *values.shape[2:])) * kept


class Frame:
    """The P kept objects of one frame, without gradients.

    what (B, P, Z), windows (B, P, 4) as (s_y, s_x, t_y, t_x), presence, depth (B, P), alpha (B, P, g, g).
    """

    def __init__(self, step: Step) -> None:
        before, found = step.propagated, step.proposals
        objects = None if before is None else before.objects

        def pick(name: str) -> Tensor:
            return held(step, None if objects is None else getattr(objects, name), getattr(found, name)).detach()

        self.what, self.windows, self.depth = pick("what"), window_of(pick("where")), pick("depth").squeeze(-1)
        presence = None if objects is None else objects.presence.squeeze(-1)
        self.presence = held(step, presence, step.found).detach()
        self.alpha = held(step, None if step.drawn is None else step.drawn[:, :, -1], step.drawn_found[:, :, -1])
        self.kept = step.kept


def frame_masks(
    frame: Frame, layers: Layers, foreground: Float[Tensor, "B H W"], readout: Readout
) -> Float[Tensor, "B P_plus_1 H W"]:
    """Masks of the kept objects and, last, of the background; they sum to 1.

    Components that are rendered but not kept (proposals with a presence below the tracking threshold) count as
    background.

    Args:
        frame: the kept objects.
        layers: sums over all rendered components.
        foreground: A.
        readout: "rendering": the shares that an object and the background have in the rendered pixel, alpha_k w_k and
            1 - A, scaled to sum to 1. "overlay": the original's visualisation, hard masks: background where A is at
            most 0.3, else the component with the largest w_k.
    """
    size = foreground.shape[-1]
    each = part_size(frame.alpha.shape[1], size * size * len(foreground), foreground)
    objects = []
    for alpha, windows, presence, depth in zip(
        *(x.split(each, dim=1) for x in (frame.alpha, frame.windows, frame.presence, frame.depth)), strict=True
    ):
        present = full(alpha) * presence[..., None, None]
        mask = paster_of(windows, alpha.shape[-1], size).each(present[:, :, None]).squeeze(2)
        importance = torch.sigmoid(-full(depth))[..., None, None] * mask
        objects.append(importance * mask if readout == "rendering" else importance)
    masks = torch.cat(objects, dim=1)
    if readout == "rendering":
        weight = layers.weight.detach() + GUARD
        total = (layers.share + (1 - foreground.detach()) * weight).clamp_min(GUARD)
        masks = masks / total[:, None]
    else:
        best = masks.max(dim=1, keepdim=True)
        chosen = torch.zeros_like(masks).scatter_(1, best.indices, 1.0)
        rest = layers.weight.detach()[:, None] - masks.sum(1, keepdim=True)  # of what is not kept
        shown = (foreground.detach()[:, None] > FAINT) & (best.values > 0) & (best.values >= rest)
        masks = chosen * shown
    return torch.cat([masks, (1 - masks.sum(1, keepdim=True)).clamp_min(0)], dim=1)


def frame_means(
    frame: Frame, colour: Float[Tensor, "B P 3 g g"], backdrop: Float[Tensor, "B 3 H W"]
) -> Float[Tensor, "B P_plus_1 3 H W"]:
    """Each kept object's own image, black outside of its window, and the background's."""
    pasted = paster_of(frame.windows, colour.shape[-1], backdrop.shape[-1]).each(full(colour))
    return torch.cat([pasted * frame.kept[..., None, None, None], backdrop[:, None]], dim=1).clamp(0, 1)


def shown_windows(frames: list[Frame]) -> Float[Tensor, "B T P_plus_1 4"]:
    """Windows of the kept objects; NaN for empty slots and for the background."""
    windows = torch.stack([f.windows.masked_fill(~f.kept[..., None], torch.nan) for f in frames], dim=1)
    return torch.cat([windows, torch.full_like(windows[:, :, :1], torch.nan)], dim=2)


def diagnostics(
    steps: list[Step], frames: list[Frame], kept: Bool[Tensor, "B T P"], foreground: Float[Tensor, "B T H W"]
) -> dict[str, Tensor]:
    """Curves worth watching; no gradient."""
    count = kept.sum().clamp_min(1)
    accepted = torch.stack([step.accepted for step in steps], dim=1)
    found = torch.stack([step.found for step in steps], dim=1).detach()
    width = torch.stack([frame.windows[..., :2].mean(-1) for frame in frames], dim=1)
    presence = torch.stack([frame.presence for frame in frames], dim=1)
    came = torch.stack([step.alive for step in steps], dim=1).sum()
    slots = kept.shape[-1]
    stayed = torch.stack([step.kept & (step.source < slots) for step in steps], dim=1).sum()
    return {
        "live_objects": kept.float().sum(-1).mean(),
        "foreground": foreground.detach().mean(),
        "window_size": (width * kept).sum() / count,
        "presence": presence.sum() / count,
        "discovered": found.sum(-1).mean(),
        "rejected_share": 1 - accepted.float().mean(),
        "stayed_share": stayed / came.clamp_min(1),
    }

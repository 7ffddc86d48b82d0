"""From the frames of a video to its `Scene` (scalor.md section 14)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from apex_lab.models.scalor.composition import Layers, paster_of
from apex_lab.models.scalor.latents import GUARD
from apex_lab.models.scalor.rollout import Step, joined_candidates
from apex_lab.models.scalor.windowed import places_of, squares
from apex_lab.nn.precision import full
from apex_lab.nn.slots import gather_slots
from apex_lab.nn.spatial_transformer import for_paste, window_of
from apex_lab.nn.splitting import part_size

Readout = Literal["rendering", "overlay"]
Untracked = Literal["background", "dropped"]

FAINT = 0.3
"""The original's overlay is shown where the foreground's mask is above this."""


def held(step: Step, propagated: Tensor | None, found: Tensor) -> Tensor:
    """Values of the candidates that the P slots hold after the frame, (B, P, ...); zero where they hold nothing."""
    values = gather_slots(joined_candidates(step, propagated, found), step.source)
    return values * step.kept.reshape(*step.kept.shape, *([1] * (values.dim() - 2)))


class Shapes(NamedTuple):
    """What masks of K components are made of: alpha (B, K, g, g), windows (B, K, 4), presence, depth (B, K)."""

    alpha: Tensor
    windows: Tensor
    presence: Tensor
    depth: Tensor

    def pasted(self, size: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Masks and importances kappa in images of `size` px, (B, some of K, H, W) at a time."""
        each = part_size(self.alpha.shape[1], size * size * len(self.alpha), self.alpha)
        for alpha, windows, presence, depth in zip(*(x.split(each, dim=1) for x in self), strict=True):
            present = full(alpha) * presence[..., None, None]
            mask = paster_of(windows, alpha.shape[-1], size).each(present[:, :, None]).squeeze(2)
            yield mask, torch.sigmoid(-full(depth))[..., None, None] * mask

    def weighed(self, size: int) -> Float[Tensor, "B K H W"]:
        """Products of masks and importances in images of `size` px."""
        if self.alpha.device.type != "cpu" or torch.compiler.is_compiling():
            return torch.cat([importance * mask for mask, importance in self.pasted(size)], dim=1)
        factors = torch.sigmoid(-full(self.depth)) * self.presence.square()
        return squares(full(self.alpha), factors, places_of(for_paste(full(self.windows)), size))


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
        self.alpha = held(
            step, None if step.drawn is None else step.drawn.detach()[:, :, -1], step.drawn_found[:, :, -1]
        )
        self.kept = step.kept
        self._step = step

    def objects(self) -> Shapes:
        """The kept objects."""
        return Shapes(self.alpha, self.windows, self.presence, self.depth)

    def untracked(self) -> Shapes:
        """The D cells, those that are kept with a presence of zero. What is propagated and present is always kept."""
        step, cells = self._step, self._step.proposals
        slots = step.kept.shape[1]
        held = step.kept.new_zeros((len(step.kept), slots + step.found.shape[1]), dtype=torch.long)
        held = held.scatter_add(1, step.source, step.kept.long())[:, slots:] > 0
        return Shapes(
            step.drawn_found[:, :, -1],
            window_of(cells.where).detach(),
            step.found.detach() * ~held,
            cells.depth.detach().squeeze(-1),
        )


def frame_masks(
    frame: Frame,
    layers: Layers,
    foreground: Float[Tensor, "B H W"],
    readout: Readout,
    untracked: Untracked = "background",
) -> Float[Tensor, "B P_plus_1 H W"]:
    """Masks of the kept objects and, last, of the background; they sum to 1.

    Args:
        frame: the kept objects.
        layers: sums over all rendered components.
        foreground: A.
        readout: "rendering": the shares that an object and the background have in the rendered pixel, alpha_k w_k and
            1 - A, scaled to sum to 1. "overlay": the original's visualisation, hard masks: background where A is at
            most 0.3, else the component with the largest w_k.
        untracked: components that are rendered but not kept (proposals with a presence below the tracking threshold):
            "background": their share of a pixel is the background's; "dropped": they have none, and the kept objects
            and the background share the pixel.
    """
    size, foreground = foreground.shape[-1], foreground.detach()
    if readout == "overlay":
        masks = _overlay(frame, foreground, untracked)
    else:
        masks = frame.objects().weighed(size)
        share = layers.share if untracked == "background" else masks.sum(1)
        total = (share + (1 - foreground) * (layers.weight.detach() + GUARD)).clamp_min(GUARD)
        masks = masks.div_(total[:, None])
    return torch.cat([masks, (1 - masks.sum(1, keepdim=True)).clamp_min(0)], dim=1)


def _overlay(frame: Frame, foreground: Float[Tensor, "B H W"], untracked: Untracked) -> Float[Tensor, "B P H W"]:
    """1 where a kept object has the largest importance of all components and the foreground is shown, else 0."""
    size = foreground.shape[-1]
    importance = torch.cat([importance for _, importance in frame.objects().pasted(size)], dim=1)
    best = importance.max(dim=1, keepdim=True)
    shown = (foreground[:, None] > FAINT) & (best.values > 0)
    if untracked == "background":
        for _, others in frame.untracked().pasted(size):
            shown &= best.values >= others.amax(dim=1, keepdim=True)
    return torch.zeros_like(importance).scatter_(1, best.indices, 1.0) * shown


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

"""The `Scene` of what SPACE infers: N cells, then the K background parts merged (space.md section 10)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apex_lab.models.space.foreground import Drawn
from apex_lab.models.space.latents import Cells
from apex_lab.scene import BACKGROUND_ID, Scene

LIVE = 0.5
"""A cell holds an object where q(pres) is above it (section 10)."""


class Found(NamedTuple):
    """What was inferred of n images; backdrop and reconstruction (n, 3, H, W), RGB in [0, 1]."""

    cells: Cells
    drawn: Drawn
    backdrop: Tensor
    reconstruction: Tensor


def scene_of(found: Found, terms: dict[str, Tensor], batch: int, detail: bool) -> Scene:
    """Scene of `batch` videos: masks w A of the cells and 1 - alpha, presence q(pres), ids the cell's index + 1.

    Args:
        found: of all frames, videos slowest.
        terms: loss terms of the videos.
        batch: B.
        detail: fill windows and means.
    """
    cells, drawn = found.cells, found.drawn
    n, count = cells.presence.shape
    alpha = drawn.composition.alpha.detach()
    masks = torch.cat([drawn.composition.shares, (1 - alpha[:, None]).clamp_min(0)], dim=1)
    index = torch.arange(count + 1, device=masks.device)
    background = index == count
    ids = torch.where(background, BACKGROUND_ID, index + 1)

    def video_of(values: Tensor) -> Tensor:
        return values.unflatten(0, (batch, -1))

    def with_background(values: Tensor, fill: float) -> Tensor:
        return video_of(torch.cat([values, torch.full_like(values[:, :1], fill)], dim=1))

    probability = cells.presence_prob.detach()
    live = probability > LIVE
    # a cell at the limit is absent (section 10), and a presence of 0.5 would count as present
    probability = torch.where(probability == LIVE, torch.nextafter(probability, probability.new_zeros(())), probability)
    size = cells.windows[..., :2].detach().mean(-1)
    means = None
    if detail:
        means = video_of(torch.cat([drawn.paster.each(drawn.colours), found.backdrop[:, None]], dim=1))
    return Scene(
        masks=video_of(masks),
        background=background,
        ids=ids.expand(batch, n // batch, -1),
        presence=with_background(probability, 1.0),
        appearance=with_background(cells.what, 0.0),
        reconstruction=video_of(found.reconstruction),
        terms=terms,
        windows=with_background(cells.windows, torch.nan) if detail else None,
        means=means,
        diagnostics={
            "live_objects": live.float().sum(1).mean(),
            "foreground": alpha.mean(),
            "window_size": (size * live).sum() / live.sum().clamp_min(1),
        },
    )

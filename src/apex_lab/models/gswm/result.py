"""What G-SWM infers as a `Scene`: the M kept objects and the background, last (gswm.md section 13)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.models.gswm.latents import Attributes
from apex_lab.models.gswm.rendering import Drawn
from apex_lab.nn.spatial_transformer import window_of
from apex_lab.scene import ABSENT, BACKGROUND_ID, Scene

PRESENT = 0.5
"""Presence from which an object counts, in the published read-out too."""


def scene_of(
    objects: Attributes,
    ids: Int[Tensor, "B T M"],
    tracked: Bool[Tensor, "B T M"],
    drawn: Drawn,
    backdrops: Float[Tensor, "B T 3 H W"],
    terms: dict[str, Tensor],
    state: Any,
    detail: bool,
) -> Scene:
    """Puts a video's objects (B, T, M, ...) and images together; `tracked`: the object was there in the frame before.

    A slot of presence zero holds nothing; one of low presence is an object that `Scene.segmentation` leaves out.
    """
    b, t, slots = ids.shape
    masks = drawn.masks.unflatten(0, (b, t))
    presence = objects.pres[..., 0]
    size, centre = objects.where.split(2, dim=-1)
    box = torch.cat([size.abs(), centre], dim=-1)  # a negative size is a mirrored glimpse in a box of that size
    windows = means = None
    if detail:
        windows = window_of(box)
        windows = torch.cat([windows, torch.full_like(windows[:, :, :1], torch.nan)], dim=2)
        assert drawn.means is not None
        means = torch.cat([drawn.means.unflatten(0, (b, t)), backdrops[:, :, None]], dim=2)
    with torch.no_grad():
        live = (presence > PRESENT).float()
        count = live.sum().clamp_min(1)
        diagnostics = {
            "live_objects": live.sum(-1).mean(),
            "presence": presence.mean(),
            "foreground": masks.sum(2).mean(),
            "window_size": (live * box[..., :2].mean(-1)).sum() / count,
            "tracked_share": (live * tracked).sum() / count,
        }
    return Scene(
        masks=torch.cat([masks, 1 - masks.sum(2, keepdim=True)], dim=2),
        background=torch.arange(slots + 1, device=ids.device) == slots,
        ids=torch.cat([torch.where(presence > 0, ids, ABSENT), torch.full_like(ids[..., :1], BACKGROUND_ID)], dim=-1),
        presence=torch.cat([presence, torch.ones_like(presence[..., :1])], dim=-1),
        appearance=torch.cat([objects.what, torch.zeros_like(objects.what[..., :1, :])], dim=2),
        reconstruction=drawn.reconstruction.unflatten(0, (b, t)),
        terms=terms,
        windows=windows,
        means=means,
        diagnostics=diagnostics,
        state=state,
    )

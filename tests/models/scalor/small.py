"""Small SCALORs and videos for tests."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apex_lab.models.scalor import FreeSize, Scalor
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Context, Scene, schedule_at

SCHEDULE = {"temperature": 1.0, "discovery_presence": 0.1, "slot_gradient": 1.0, "alpha_curriculum": 0.0}


def small(seed: int = 0, lively: bool = True, **arguments: Any) -> Scalor:
    """32 px, 4 x 4 cells. `lively`: with larger weights in the heads, so that samples differ between objects."""
    torch.manual_seed(seed)
    model = Scalor(
        **{"image_size": 32, "grid": 4, "glimpse_size": 16, "max_objects": 6, "size": FreeSize(), **arguments}
    )
    if lively:
        with torch.no_grad():
            for head in (model.objects.discovery.presence[-1], model.objects.discovery.depth[-1]):
                head.weight.mul_(8)
            model.objects.glimpse_decoder.alpha.out.weight.mul_(4)
    return model


def clip(videos: int = 2, frames: int = 4, size: int = 32, seed: int = 0) -> Tensor:
    """Two coloured squares that move over noise."""
    g = torch.Generator().manual_seed(seed)
    video = 0.2 * torch.rand(videos, frames, 3, size, size, generator=g)
    side = size // 5
    for i in range(videos):
        for colour in torch.rand(2, 3, generator=g):
            y, x, dy, dx = torch.randint(0, size - 2 * side, (4,), generator=g).tolist()
            for t in range(frames):
                top, left = (y + t * (dy % 3)) % (size - side), (x + t * (dx % 3)) % (size - side)
                video[i, t, :, top : top + side, left : left + side] = colour[:, None, None]
    return video


def run(
    model: Scalor, video: Tensor, names: list[int] | None = None, state: Any = None, first: int = 0, **kw: Any
) -> Scene:
    """A pass with noise that is a function of video and frame."""
    detail = kw.pop("detail", False)
    noise = VideoNoise(0, names or list(range(len(video))), first)
    return model(video, Context(schedule_at({**SCHEDULE, **kw}), noise, state, detail))

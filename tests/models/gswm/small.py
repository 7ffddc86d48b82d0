"""What tests of G-SWM share: the model at its smallest, videos, schedules, noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apex_lab.models.gswm import Background, Gswm, ImageEncoder, Motion
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Context, schedule_at

SIZE = 32
SCHEDULE = {
    "temperature": 0.7,
    "presence_prior": 0.01,
    "scale_mean": -1.2,
    "sigma": 0.2,
    "background_only": 0.0,
}


def tiny(norm: Any = "frame", grid: int = 4, background: bool = True, **changes: Any) -> Gswm:
    """G-SWM with every part at its smallest, whose objects move, overlap and vanish: its weights are large."""
    torch.manual_seed(0)
    model = Gswm(
        SIZE,
        ImageEncoder(SIZE, grid, (8, 8, 12), (1, 2, 1), 8, norm),
        Background(SIZE, 6, 10, (4, 4, 8), (8, 4, 4)) if background else None,
        Motion(),
        **{
            "max_objects": 4,
            "what": 5,
            "dyna": 7,
            "hidden": 12,
            "glimpse_size": 8,
            "glimpse_widths": (4, 4, 8),
            "rejection_iou": 0.2,
        }
        | changes,
    )
    with torch.no_grad():
        for weight in (p for p in model.parameters() if p.dim() > 1):
            weight.mul_(1.7)  # signals keep their scale from layer to layer
        for part, presence in ((model.discovery.attribute_head[-1], -4.0), (model.propagation.change_net[-1], 2.0)):
            assert isinstance(part, nn.Linear | nn.Conv2d)
            assert part.bias is not None
            part.weight.mul_(3)
            part.bias[0] = presence
    return model


@pytest.fixture
def double() -> Iterator[None]:
    """Double precision, in which objects that vanish early or late do so for reasons, not by rounding."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def video(b: int = 3, t: int = 5, seed: int = 1) -> Tensor:
    return torch.rand(b, t, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))


def context(
    videos: Sequence[int] = (0, 1, 2), first: int = 0, state: Any = None, detail: bool = False, **changes: float
) -> Context:
    """A schedule with these changes, and noise of these videos from frame `first` on."""
    return Context(schedule_at(SCHEDULE | changes), VideoNoise(0, videos, first), state, detail)


def loss(terms: dict[str, Tensor]) -> Tensor:
    return torch.stack([value.mean() for value in terms.values()]).sum()

"""What the tests of SPACE share: small models, contexts, published arrays."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from apex_lab.models.space import Space
from apex_lab.scene import Context, Noise, schedule_at

VALUES = {"temperature": 0.7, "presence_prior": 0.05, "scale_prior": -1.5, "fix_alpha": 0.0, "fixed_alpha": 0.1}


@cache
def published() -> dict[str, Tensor]:
    """Arrays of the published implementation, by name."""
    with np.load(Path(__file__).parent / "fixtures" / "space.npz", allow_pickle=False) as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files}


def context(noise: Noise | None = None, detail: bool = False, **values: float) -> Context:
    return Context(schedule_at({**VALUES, **values}), noise or Noise(), None, detail)


def small(seed: int = 0, **changes: Any) -> Space:
    """A 32 px model whose biases and gains differ from layer to layer."""
    torch.manual_seed(seed)
    model = Space(**{"image_size": 32, "grid": 4, "components": 3, **changes})
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad and parameter.dim() == 1:
                parameter.add_(0.05 * torch.randn_like(parameter))
        for norm in model.modules():
            if isinstance(norm, nn.BatchNorm2d):
                assert norm.running_mean is not None
                assert norm.running_var is not None
                norm.running_mean.normal_(0, 0.1)
                norm.running_var.uniform_(0.5, 1.5)
    return model


def video(seed: int = 0, shape: tuple[int, ...] = (2, 3, 3, 32, 32)) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def close(found: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Equal to a tolerance relative to the largest expected magnitude."""
    assert found.shape == expected.shape
    largest = expected.abs().max().clamp_min(1e-12)
    error = ((found - expected).abs().max() / largest).item()
    assert error < tolerance, f"relative error {error:.2e}"

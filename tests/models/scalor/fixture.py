"""Arrays of the published implementation, and the deterministic weights and inputs they were made with."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

_FILE = np.load(Path(__file__).parent / "fixtures" / "scalor.npz", allow_pickle=False)


def array(name: str) -> Tensor:
    """The array `group/name`."""
    return torch.from_numpy(np.asarray(_FILE[name]))


def set_weights(parameters: Iterable[nn.Parameter]) -> None:
    """Tensor number j, flat index i: sin(1 + 0.7 j + 0.37 i) / sqrt(fan-in), or 0.5 + 0.5 sin(...) for one dim."""
    with torch.no_grad():
        for j, parameter in enumerate(parameters):
            wave = torch.sin(1 + 0.7 * j + 0.37 * torch.arange(parameter.numel(), dtype=torch.float64))
            if parameter.dim() > 1:
                wave = wave / math.sqrt(parameter.numel() / len(parameter))
            else:
                wave = 0.5 + 0.5 * wave
            parameter.copy_(wave.reshape(parameter.shape).float())


def det(*shape: int) -> Tensor:
    """Element i is 0.5 + 0.5 sin(0.11 i + 0.3)."""
    count = torch.arange(math.prod(shape), dtype=torch.float64)
    return (0.5 + 0.5 * torch.sin(0.11 * count + 0.3)).reshape(shape).float()


def parameters_of(*modules: nn.Module) -> int:
    return sum(p.numel() for module in modules for p in module.parameters())

"""Every update's values, looked at without making the device wait; the batch of one that is not finite is kept."""

from __future__ import annotations

import io
import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apex_lab.base.files import replacing

LAG = 2
"""Updates that a GPU may be ahead of the look at their values, so that it never waits for the look."""

FILE = "diverged.npz"
"""In the run's folder: the batch of the update that was not finite."""


@dataclass(frozen=True)
class Seen:
    """One update.

    Attributes:
        step: weight updates made with it.
        row: its values: loss, terms, diagnostics, gradient norm.
        batch: its clips, of this rank.
    """

    step: int
    row: dict[str, float]
    batch: Mapping[str, Any]


@dataclass(frozen=True)
class _Pending:
    step: int
    names: tuple[str, ...]
    values: Tensor
    copied: torch.cuda.Event | None
    batch: Mapping[str, Any]


class Watch:
    """Looks at the values of each update, on a GPU some updates later, always the same number on every rank.

    Args:
        decisive: names of the values that must be finite.
    """

    def __init__(self, decisive: Sequence[str]) -> None:
        self._decisive = tuple(decisive)
        self._pending: deque[_Pending] = deque()

    def add(self, step: int, latest: Mapping[str, Tensor], batch: Mapping[str, Any]) -> Seen | None:
        """Takes an update in; the first one that turns out not to be finite.

        Args:
            step: weight updates made.
            latest: `WeightUpdate.latest`, 0-dim tensors.
            batch: the clips.
        """
        names = tuple(latest)
        values, copied = torch.stack([latest[name].float() for name in names]), None
        if values.is_cuda:
            host = torch.empty(values.shape, pin_memory=True)
            host.copy_(values, non_blocking=True)
            copied = torch.cuda.Event()
            copied.record()
            values = host
        self._pending.append(_Pending(step, names, values, copied, batch))
        return self.look(LAG if copied is not None else 0)

    def look(self, lag: int = 0) -> Seen | None:
        """The first update that was not finite among all but the last `lag` that were not looked at; waits for them."""
        while len(self._pending) > lag:
            one = self._pending.popleft()
            if one.copied is not None:
                one.copied.synchronize()
            row = dict(zip(one.names, one.values.tolist(), strict=True))
            if any(not math.isfinite(row.get(name, 0.0)) for name in self._decisive):
                return Seen(one.step, row, one.batch)
        return None


def keep(folder: Path, seen: Seen) -> Path:
    """Stores an update's batch as plain arrays: `video` (B, T, 3, H, W) uint8, `name`, `index`, `step`, `values`.

    `values` is JSON: name -> the value as text, since JSON has no NaN.

    Returns:
        The file.

    Raises:
        UserError: it cannot be written.
    """
    arrays = {key: value.cpu().numpy() for key, value in seen.batch.items() if isinstance(value, Tensor)}
    arrays["name"] = np.array([str(name) for name in seen.batch.get("name", ())])
    arrays["step"] = np.array(seen.step)
    arrays["values"] = np.array(json.dumps({name: repr(value) for name, value in seen.row.items()}))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    with replacing(folder / FILE) as file:
        file.write(buffer.getvalue())
    return folder / FILE

"""Activations that are computed again in the backward pass instead of being kept for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch.utils.checkpoint import checkpoint

Level = Literal["nothing", "objects", "everything"]


class Recompute:
    """Runs parts of a forward pass with or without keeping their activations.

    What runs here draws no random numbers, so that its second run equals the first.

    Args:
        active: activations are computed again; False, or gradients that are off: a plain call.
    """

    def __init__(self, active: bool) -> None:
        self.active = active

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if not self.active or not torch.is_grad_enabled():
            return function(*arguments)
        return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)

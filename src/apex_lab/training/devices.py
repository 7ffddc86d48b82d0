"""What training sets up for the device that it runs on: the precision of products, and the optimiser's kind."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor
from torch.optim import Optimizer

from apex_lab.training.composite import Composite

MatmulPrecision = Literal["highest", "high", "medium"]
"""As of `torch.set_float32_matmul_precision`; "high" is TF32."""


def set_matmul_precision(device: torch.device, precision: MatmulPrecision) -> None:
    """How this process multiplies float32 matrices on a GPU; nothing on a CPU, which could do it in bfloat16 too.

    By the older of PyTorch's two interfaces: up to torch 2.11 its compiler reads that one, and refuses to once the
    newer one (`torch.backends.cuda.matmul.fp32_precision`) was used (pytorch #189955).
    """
    if device.type == "cuda":
        torch.set_float32_matmul_precision(precision)


def adapt(optimizer: Optimizer, captured: bool) -> None:
    """Makes an optimiser fit its weights' device, wherever its state was made.

    On a GPU PyTorch's own optimisers are fused where they can be and nothing else was asked for, one kernel in place of
    dozens; what is captured in a CUDA graph has its learning rates and its counts of updates on the device, and updates
    all weights together. A state that was loaded brings the options of where it comes from; they are set again.

    Args:
        optimizer: with or without a state.
        captured: its step is captured.
    """
    for one in optimizer.members.values() if isinstance(optimizer, Composite) else (optimizer,):
        for group in one.param_groups:
            _adapt_group(one, group, captured)


def _adapt_group(optimizer: Optimizer, group: dict[str, Any], captured: bool) -> None:
    device = group["params"][0].device
    rate = float(group["lr"])
    group["lr"] = torch.tensor(rate, device=device) if captured else rate
    if "capturable" in group:
        group["capturable"] = captured or optimizer.defaults["capturable"]
    if "fused" in group:
        group["fused"] = _fused(optimizer, device)
    if "foreach" in group:
        asked = optimizer.defaults["foreach"]
        # one weight at a time, RMSprop would read its learning rate
        group["foreach"] = True if captured and asked is None and not group.get("fused") else asked
    counted_there = group.get("capturable") or group.get("fused")
    for weight in group["params"]:
        count = optimizer.state.get(weight, {}).get("step")
        if isinstance(count, Tensor):
            optimizer.state[weight]["step"] = count.float().to(device if counted_there else "cpu")


def _fused(optimizer: Optimizer, device: torch.device) -> bool | None:
    """What was asked for when the optimiser was built; by default fused on a GPU."""
    asked = optimizer.defaults["fused"]
    free = asked is None and not (optimizer.defaults.get("foreach") or optimizer.defaults.get("differentiable"))
    return True if free and device.type == "cuda" else asked

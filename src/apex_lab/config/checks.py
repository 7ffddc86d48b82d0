"""Checks of what a configuration builds: whether it is of the right kind, and does what training asks of it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch
from torch import nn

from apex_lab.base import faults
from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence, shown
from apex_lab.config import components

Builder = Callable[[Sequence[tuple[str, nn.Parameter]]], torch.optim.Optimizer]
"""Named weights -> their optimiser."""

RATE = 1e9
"""Learning rates lie below it; so their product with `lr_scale` is a number in single precision."""


def refuse_others(node: Mapping[str, Any], key: str, kind: Literal["Logger", "Callback"]) -> None:
    """A class of another kind would be found out by Lightning, in the middle of its work."""
    classes = getattr(components.target_of(node, key), "__mro__", ())
    # by name, since this module needs no Lightning
    if not any(one.__name__ == kind and one.__module__.startswith(_LIGHTNING) for one in classes):
        raise UserError(f"{key}._target_ = {shown(node['_target_'])} is no {kind} of Lightning: name a class that is.")


_LIGHTNING = ("lightning.", "pytorch_lightning.")


def refuse_checkpoints(node: Mapping[str, Any], key: str) -> None:
    """A second writer of checkpoints would meet the files that a run resumes from."""
    classes = getattr(components.target_of(node, key), "__mro__", ())
    # by name, since this module needs no Lightning
    if any(one.__name__ == "Checkpoint" and one.__module__.endswith(".callbacks.checkpoint") for one in classes):
        raise UserError(
            f"{key}: a run keeps its checkpoints itself (trainer.checkpoint_interval, trainer.monitor): "
            f"leave {node['_target_']} out."
        )


def refuse_missing_package(node: Mapping[str, Any], key: str) -> None:
    """A component that needs a package which does not come with apex_lab names it, and the extra that brings it."""
    package, extra = getattr(components.target_of(node, key), "NEEDS", (None, None))
    if package is not None and importlib.util.find_spec(package) is None:
        raise UserError(f"{key} needs a package that is not installed: pip install 'apex-lab[{extra}]'.")


def check_update(build: Builder, weights: Sequence[tuple[str, nn.Parameter]], target: object) -> None:
    """Builds an optimiser, and makes an update of weights of the same names with one element each.

    An optimiser may refuse only then what it was built with: dense gradients, or a step without a closure.

    Args:
        build: makes the optimiser of named weights.
        weights: those that are trained.
        target: name of its class.

    Raises:
        UserError: it cannot update them.
    """
    for group in build(weights).param_groups:
        if not 0 <= float(group["lr"]) <= RATE:
            raise UserError(f"optimizer: a learning rate of {float(group['lr']):g} is wrong: it is at most {RATE:g}.")
    small = [(name, nn.Parameter(torch.zeros([1] * weight.ndim))) for name, weight in weights]
    for _, weight in small:
        weight.grad = torch.zeros_like(weight)
    optimizer = build(small)
    try:
        optimizer.step()
    except Exception as error:
        told = faults.told(error, f"optimizer ({target}) cannot update this model's weights")
        raise UserError(told) from error


def looked_at(last: int) -> list[int]:
    """Steps at which schedules are looked at: some 1,000, the first and the last among them."""
    return [*range(0, last, max(1, last // 1000)), last]


def check_range(key: str, schedule: Callable[[int], float], within: tuple[float, float], last: int) -> None:
    """A schedule must stay within its limits at every step that a run makes; looked at in at most some 1,000 steps."""
    low, high = (min(max(limit, -_FLOAT), _FLOAT) for limit in within)
    for step in looked_at(last):
        try:
            value = float(schedule(step))
        except Exception as error:
            told = (
                one_line(error) if isinstance(error, TypeError | ValueError | AttributeError) else faults.cited(error)
            )
            raise UserError(sentence(f"{key} is not a schedule, which gives a number for a step: {told}")) from error
        if not low <= value <= high:
            reach = f"at least {low:g}" if value < low and high == _FLOAT else f"between {low:g} and {high:g}"
            raise UserError(f"{key} is {value:g} at step {step}: it must be {reach}.")


_FLOAT = torch.finfo(torch.float32).max

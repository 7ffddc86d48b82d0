"""`Scene.state` as plain arrays, so that it can be stored without a class of the model being named in the file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

Leaf = Tensor | bool | int | float | str | None


def leaves(state: Any) -> list[Leaf]:
    """The tensors and plain values of nested tuples, lists, dictionaries and dataclasses, in order.

    Raises:
        TypeError: something else is in it.
    """
    if isinstance(state, Tensor):
        return [state.detach().cpu()]
    if isinstance(state, np.ndarray):
        return [torch.from_numpy(np.ascontiguousarray(state))]
    if state is None or isinstance(state, (bool, int, float, str)):
        return [state]
    return [leaf for child in _children(state) for leaf in leaves(child)]


def refilled(template: Any, values: Sequence[Leaf], device: torch.device) -> Any:
    """A state in the structure of another state of the same model, with other tensors and values.

    Args:
        template: a state.
        values: `leaves` of the state that is wanted; sizes may differ from the template's.
        device: where its tensors lie.

    Raises:
        ValueError: the values do not fit the structure.
    """
    rest = iter(values)
    found = _filled(template, rest, device)
    if next(rest, _END) is not _END:
        raise ValueError("more values than the state has places")
    return found


_END = object()


def _filled(template: Any, rest: Iterator[Leaf], device: torch.device) -> Any:
    if isinstance(template, (Tensor, np.ndarray)):
        value = next(rest, None)
        if not isinstance(value, Tensor):
            raise ValueError(f"{type(value).__name__} in place of a tensor")
        return value.numpy() if isinstance(template, np.ndarray) else value.to(device)
    if template is None or isinstance(template, (bool, int, float, str)):
        plain: Any = next(rest, _END)
        if type(plain) is not type(template):
            raise ValueError(f"{type(plain).__name__} in place of {type(template).__name__}")
        return plain
    children = [_filled(child, rest, device) for child in _children(template)]
    if isinstance(template, dict):
        return dict(zip(template, children, strict=True))
    if dataclasses.is_dataclass(template):
        names = [field.name for field in dataclasses.fields(template)]
        return dataclasses.replace(template, **dict(zip(names, children, strict=True)))  # type: ignore[type-var]
    if hasattr(template, "_fields"):
        return type(template)(*children)
    return type(template)(children)


def _children(state: Any) -> list[Any]:
    if isinstance(state, dict):
        return list(state.values())
    if isinstance(state, (tuple, list)):
        return list(state)
    if dataclasses.is_dataclass(state) and not isinstance(state, type):
        return [getattr(state, field.name) for field in dataclasses.fields(state)]
    raise TypeError(f"a state may not hold {type(state).__name__}")

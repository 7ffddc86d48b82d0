"""A CUDA graph on a CPU: records the operations of a step and repeats them in the same memory.

What it shares with the real one: Python does not run again, so every number that Python handed over stays as it was;
inputs, results and state lie where they lay in capture; what the host would have to read, or copy to the device, is
refused; capture changes no number; random numbers come from PyTorch's generator as it stands at the replay.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from apex_lab.training.capture import SideStream

READS = ("_local_scalar_dense", "nonzero", "is_nonzero", "item", "equal", "masked_select", "_unique", "_unique2")
COPIES = ("tolist", "numpy", "cpu", "__array__", "tensor", "as_tensor", "new_tensor", "from_numpy")


class Refused(Exception):
    """An operation that a capture does not allow."""


class Recorder(TorchDispatchMode):
    """Notes what is done, and refuses what has to wait for the device, or has a shape that data decide."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, Any]] = []
        self._before: dict[int, tuple[Tensor, Tensor]] = {}
        self._made: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = kwargs or {}, func.overloadpacket.__name__
        if name in READS or (name in ("index", "index_put", "index_put_") and _boolean(args[1])):
            raise Refused(name)
        for written in _written(func, args, kwargs):
            self._keep(written)
        results = func(*args, **kwargs)
        self.done.append((func, args, kwargs, results))
        if not _views(func) and not _writes(func):
            self._made |= {_place(x) for x in tree_leaves(results) if isinstance(x, Tensor)}
        return results

    def _keep(self, written: Tensor) -> None:
        """What a tensor from outside held before."""
        place = _place(written)
        if place not in self._made and place not in self._before:
            whole = torch.empty(0, dtype=written.dtype).set_(written.untyped_storage())
            self._before[place] = (whole, whole.clone())

    def undo(self) -> None:
        """Everything from outside as it was."""
        with torch.no_grad():
            for whole, before in self._before.values():
                whole.copy_(before)

    def repeat(self) -> None:
        """Everything once more, in the same memory."""
        with torch.no_grad():
            for func, args, kwargs, results in self.done:
                if _views(func):
                    continue
                found = func(*args, **kwargs)
                if not _written(func, args, kwargs):
                    for old, new in zip(tree_leaves(results), tree_leaves(found), strict=True):
                        if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                            assert old.shape == new.shape, f"{func} gave {old.shape}, now {new.shape}"
                            old.detach().copy_(new)


class NoCopies(TorchFunctionMode):
    """Refuses calls that copy between host and device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__name__", "") in COPIES:
            raise Refused(func.__name__)
        return func(*args, **(kwargs or {}))


class Replayed:
    """In place of `apex_lab.training.capture.Captured`."""

    def __init__(self, work: Callable[[Tensor], dict[str, Tensor]], given: Tensor, side: SideStream) -> None:
        self.shape = given.shape
        self._given = given.clone()
        self._recorder = Recorder()
        with torch.random.fork_rng(devices=[]), NoCopies(), self._recorder:
            self._values = work(self._given)
        self._recorder.undo()

    def __call__(self, given: Tensor) -> dict[str, Tensor]:
        self._given.copy_(given)
        self._recorder.repeat()
        return self._values


def traced(work: Callable[[], object]) -> list[tuple[str, tuple[Any, ...]]]:
    """Operations of a piece of work, with shapes of tensors and all other arguments as they are.

    Raises:
        Refused: it holds what a capture does not allow.
    """
    recorder = Recorder()
    with NoCopies(), recorder:
        work()
    return [
        (str(func), tuple(_told(x) for x in tree_leaves((args, kwargs)))) for func, args, kwargs, _ in recorder.done
    ]


def _told(value: Any) -> Any:
    return (tuple(value.shape), value.stride(), value.dtype) if isinstance(value, Tensor) else str(value)


def _boolean(indices: Any) -> bool:
    return any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in indices)


def _place(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def _written(func: Any, args: Any, kwargs: Any) -> list[Tensor]:
    """Arguments that an operation writes to."""
    values = [args[i] if i < len(args) else kwargs.get(name) for i, name in _writes(func)]
    return [x for x in tree_leaves(values) if isinstance(x, Tensor)] if values else []


@cache
def _writes(func: Any) -> list[tuple[int, str]]:
    arguments = enumerate(func._schema.arguments)
    return [(i, each.name) for i, each in arguments if each.alias_info is not None and each.alias_info.is_write]


@cache
def _views(func: Any) -> bool:
    """Whether an operation only looks at memory in another way."""
    aliases = [result.alias_info for result in func._schema.returns]
    return bool(aliases) and all(alias is not None and not alias.is_write for alias in aliases)

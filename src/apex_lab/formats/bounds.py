"""What files of strangers may declare: sizes are compared with a bound before memory is taken for them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from apex_lab.base.errors import UserError

GIGABYTES = 1.0
"""Bound of one video's arrays by default: a hundred frames of 480 x 854 pixels with six slots."""

LARGEST = 2**63
"""Identities, labels and numbers of frames lie below it in size."""

_bound: ContextVar[float] = ContextVar("bound", default=GIGABYTES)


@contextmanager
def at_most(gigabytes: float) -> Iterator[None]:
    """Inside, no array or file that is read at once may be larger."""
    token = _bound.set(gigabytes)
    try:
        yield
    finally:
        _bound.reset(token)


def check_shape(shape: Sequence[Any], itemsize: int, where: str) -> None:
    """Compares a declared shape with the bound.

    Args:
        shape: lengths of all axes, as they are declared.
        itemsize: bytes of an element.
        where: file and video, for the message.

    Raises:
        UserError: it is too large, or no shape.
    """
    if any(type(length) is not int or length < 0 for length in shape):  # as a file of others has it
        raise UserError(f"{where}: {list(shape)} is no size; want whole numbers from 0 on")
    check_bytes(math.prod(shape) * itemsize, f"{where}: an array of {' x '.join(map(str, shape))}")


def check_file(path: Path) -> None:
    """Compares the length of a file that is read at once with the bound.

    Raises:
        UserError: it is too long.
        OSError: it is not there.
    """
    check_bytes(path.stat().st_size, str(path))


def check_bytes(size: int, what: str) -> None:
    """Compares a size with the bound.

    Args:
        size: bytes.
        what: has it, for the message.

    Raises:
        UserError: it is too large.
    """
    if size > _bound.get() * 1e9:
        raise UserError(
            f"{what} needs {size / 1e9:,.2f} GB, and max_gigabytes={_bound.get():g} is allowed: raise max_gigabytes "
            "if the file is meant to be so large"
        )


def check_integer(value: Any, what: str) -> int:
    """A whole number that 64 bits hold.

    Raises:
        UserError: it is something else.
    """
    if type(value) is not int or not -LARGEST < value < LARGEST:
        shown = f"of {value.bit_length()} bits" if type(value) is int else repr(value)[:60]
        raise UserError(f"{what} is {shown}; want a whole number of 64 bits at most")
    return value

"""Data sets and their batches: P2D as a plain torch data set and as a Lightning data module."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from apex_lab.data.p2d import P2D

if TYPE_CHECKING:
    from apex_lab.data.module import P2DModule

__all__ = ["P2D", "P2DModule"]


def __getattr__(name: str) -> Any:
    # Lightning takes seconds to import, and people who bring their own training loop do not need it.
    if name == "P2DModule":
        from apex_lab.data.module import P2DModule

        return P2DModule
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

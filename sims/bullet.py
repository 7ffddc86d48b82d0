"""The door to PyBullet: importing it, and servers of one's own."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any

from sims.errors import SimError


def load_pybullet() -> Any:
    """The `pybullet` module; imported late because prepared data is usable without it.

    Raises:
        SimError: PyBullet is not installed (it has no wheels for Python 3.12 and later).
    """
    try:
        return importlib.import_module("pybullet")
    except ImportError as error:
        raise SimError(
            "PyBullet is not installed: to simulate, use Python 3.11 (there are no wheels for later versions); "
            "training on data that is already made needs no simulator."
        ) from error


def load_pybullet_data() -> str:
    """Folder of the models that ship with PyBullet (the Panda among them)."""
    load_pybullet()
    return str(importlib.import_module("pybullet_data").getDataPath())


class Client:
    """One private PyBullet server without a window."""

    def __init__(self) -> None:
        self.module = load_pybullet()
        self.id: int = self.module.connect(self.module.DIRECT)
        if self.id < 0:
            raise SimError(
                "PyBullet opened no further physics server in this process: close some, or start a new process."
            )

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """`pybullet.<name>(*args, **kwargs)` on this server."""
        return getattr(self.module, name)(*args, physicsClientId=self.id, **kwargs)

    def bound(self, name: str) -> Callable[..., Any]:
        """`pybullet.<name>` on this server, for calls that are made very often."""
        return partial(getattr(self.module, name), physicsClientId=self.id)

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        if self.id >= 0 and self.module.isConnected(self.id):
            self.module.disconnect(self.id)
        self.id = -1

"""Access to PyBullet: the module, the version that is installed, private physics servers."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

from sims.errors import SimError

INSTALL = (
    "run `pip install pybullet` (Python 3.11) or `pip install pybullet-arm64` (Python 3.12 and 3.13, see SECURITY.md)"
)


def load_pybullet() -> Any:
    """The `pybullet` module; imported late because prepared data is usable without it.

    Raises:
        SimError: PyBullet is not installed.
    """
    try:
        if (loaded := sys.modules.get("pybullet")) is not None:
            return loaded
        with _no_output():
            return importlib.import_module("pybullet")
    except ImportError as error:
        raise SimError(
            f"PyBullet is not installed: {INSTALL}; training on data that is already made needs no simulator."
        ) from error


@contextlib.contextmanager
def _no_output() -> Iterator[None]:
    """Drops what C code writes to standard error: PyBullet tells there when it was built."""
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


@lru_cache(maxsize=1)
def pybullet_version() -> str | None:
    """Version of the distribution that provides the module `pybullet`; None if there is none.

    Several distributions provide it, for example pybullet-arm64; any but `pybullet` itself is named too:
    "3.2.8 (pybullet-arm64)".
    """
    names = sorted(set(importlib.metadata.packages_distributions().get("pybullet", ())))
    found = [(name, importlib.metadata.version(name)) for name in names]
    return " + ".join(version if name == "pybullet" else f"{version} ({name})" for name, version in found) or None


def load_pybullet_data() -> str:
    """Folder of the models that ship with PyBullet (the Panda among them)."""
    load_pybullet()
    return str(importlib.import_module("pybullet_data").getDataPath())


class Client:
    """A private PyBullet server in direct mode (no GUI)."""

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

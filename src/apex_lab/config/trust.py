"""What a file of a stranger may build: decided by name before anything is imported, then by class before it is built.

A checkpoint carries the configuration that made it, whose nodes name classes. Weights are read without running code,
but building `{_target_: os.system, command: ...}` would run it. So of files, the project's own components and a short
list of PyTorch's optimisers are built, and nothing else unless it is asked for by `trust=true`.
"""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from apex_lab.base.errors import UserError
from apex_lab.base.validation import shown

OPTIMISERS = frozenset(
    f"torch.optim.{name}" for name in ("Adam", "AdamW", "Adagrad", "NAdam", "RAdam", "RMSprop", "SGD")
)
OWN = re.compile(r"apex_lab\.(models|data|training)(\.[a-z][a-z0-9_]*)*\.[A-Z]\w*")
"""Full names of the project's components: a class in one of three packages."""


def check(config: Any, where: str, known: Iterable[str] = ()) -> None:
    """Refuses a configuration that names anything but components of the project.

    Args:
        config: plain containers.
        where: the file, for the message.
        known: further names that are allowed, because the user's own configuration has them.

    Raises:
        UserError: the first name that is refused.
    """
    allowed = frozenset(known)
    for key, name in targets(config):
        if not _is_own(name) and not (isinstance(name, str) and name in allowed):
            raise UserError(
                f"{where} wants to build {shown(name)} ({key}), which is no component of apex_lab: "
                "write trust=true if you trust whoever made this file."
            )


def targets(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every `_target_` in a configuration with its key."""
    if isinstance(config, Mapping):
        for name, value in config.items():
            key = f"{prefix}.{name}" if prefix else str(name)
            if name == "_target_":
                yield key, value
            else:
                yield from targets(value, key)
    elif isinstance(config, list | tuple):
        for i, value in enumerate(config):
            yield from targets(value, f"{prefix}[{i}]")


def _is_own(name: object) -> bool:
    if not isinstance(name, str):
        return False
    if name in OPTIMISERS:
        return True
    if OWN.fullmatch(name) is None:
        return False
    try:
        found = pkgutil.resolve_name(name)  # imports modules of this package alone
    except (ImportError, AttributeError, ValueError):
        return False
    # what a module of ours has imported from elsewhere is not ours
    return isinstance(found, type) and found.__module__.startswith("apex_lab.")

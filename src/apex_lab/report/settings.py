"""Resolved configurations as lines that a command line takes, and what differs between them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

HIDDEN = ("seed", "paths")
"""Keys that say nothing about a configuration: its seeds differ in one, its machine in the other."""


class Setting(NamedTuple):
    """A key with its value.

    Attributes:
        key: as on the command line, such as `model.likelihood.sigma_fg`.
        value: as on the command line; None where this configuration has no such key and the other one has.
        other: the value in the configuration it is compared with; None where that has no such key.
        differs: whether the two differ.
    """

    key: str
    value: str | None
    other: str | None
    differs: bool


def flat(settings: Mapping[str, Any]) -> dict[str, str]:
    """Key -> value of all leaves of a configuration; an empty mapping is a leaf."""
    return dict(_leaves("", {key: value for key, value in settings.items() if key not in HIDDEN}))


def _leaves(prefix: str, node: Any) -> Iterator[tuple[str, str]]:
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from _leaves(f"{prefix}.{key}" if prefix else str(key), value)
    else:
        yield prefix, _text(node)


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)


def compared(settings: Mapping[str, str], other: Mapping[str, str]) -> list[Setting]:
    """All keys of a configuration in its order, then those that only the other has."""
    found = [
        Setting(key, value, other.get(key), key not in other or other[key] != value) for key, value in settings.items()
    ]
    return found + [Setting(key, None, value, True) for key, value in other.items() if key not in settings]


def different_keys(configurations: Sequence[Mapping[str, str]]) -> list[str]:
    """Keys that all configurations have, with not always the same value."""
    if not configurations:
        return []
    common = set(configurations[0]).intersection(*configurations[1:])
    return [key for key in configurations[0] if key in common and len({one[key] for one in configurations}) > 1]

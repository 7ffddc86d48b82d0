"""Data to score a checkpoint on that are not those it was trained with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

SIZES = ("frames", "image_size", "train", "val", "test")
"""Settings that another data set takes over from the data of the checkpoint, unless they are given."""


@dataclass(frozen=True)
class OtherData:
    """The data settings of the command line.

    Attributes:
        node: the composed `data` node; without a `_target_` where no data set was chosen.
        given: the keys below `data` on the command line, such as "simulation.max_objects".
    """

    node: Mapping[str, Any] = field(default_factory=dict)
    given: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.node)

    def instead_of(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """The node to build: the checkpoint's with the given keys, or that of another data set in the same sizes.

        Args:
            own: the `data` node of the checkpoint.
        """
        other = self.node.get("_target_", own["_target_"]) != own["_target_"]
        found = deepcopy(dict(self.node if other else own))
        if other:
            found.update({key: own[key] for key in SIZES if key in own and key in found})
        for key in self.given:
            words = key.split(".")
            _set(found, words, _get(self.node, words))
        return found


def _get(node: Mapping[str, Any], words: Sequence[str]) -> Any:
    value: Any = node
    for word in words:
        value = value[word]
    return value


def _set(node: dict[str, Any], words: Sequence[str], value: Any) -> None:
    for word in words[:-1]:
        if not isinstance(node.get(word), dict):
            node[word] = {}
        node = node[word]
    node[words[-1]] = value

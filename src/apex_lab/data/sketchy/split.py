"""Which episodes are for training, validation and testing: by file name, as GENESIS-V2 splits them."""

from __future__ import annotations

from collections.abc import Iterable

SPLITS = ("train", "val", "test")


def split_by_name(names: Iterable[str]) -> dict[str, list[str]]:
    """Sorts names as strings; the first tenth (rounded down) is for validation, the next for testing, the rest trains.

    Names of one split are in order. With fewer than ten names, validation and test get none.
    """
    ordered = sorted(names)
    tenth = len(ordered) // 10
    return {"train": ordered[2 * tenth :], "val": ordered[:tenth], "test": ordered[tenth : 2 * tenth]}

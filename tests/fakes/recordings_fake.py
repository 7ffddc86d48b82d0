"""A small kind of recording: squares of one colour, a function of (split, index) alone.

Environment variables make its maker misbehave:
    SQUARES_REFUSE=<split>-<index>  raises a RecordingError there
    SQUARES_LOG=<folder>            leaves an empty file <split>-<index> per item made
    SQUARES_UNREADABLE=1            needs a file that is missing
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recordings import Facts, Field, Item, Kind, Layout, Maker, Plan, RecordingError

KIND = Kind(
    "squares",
    make_command="make squares in {root}",
    repair_command="repair squares in {root}",
    item="square",
    items="squares",
    notes=("name", "weight"),
    totals=("weight",),
    about="Squares of one colour.",
)


def plan(train: int = 5, seed: int = 0, side: int = 4, kind: Kind[dict[str, object]] = KIND) -> Plan[dict[str, object]]:
    fields = {"rgb": Field("|u1", ("T", "S", "S", 3), "frames"), "value": Field("<f4", (), "its brightness")}
    layout = Layout(fields, {"train": train, "extra": 2}, {"T": 2, "S": side})
    return Plan(kind, {"seed": seed, "palette": ["red", "blue"]}, layout)


@dataclass(frozen=True)
class Squares(Maker):
    seed: int = 0
    side: int = 4

    def facts(self) -> Facts:
        if "SQUARES_UNREADABLE" in os.environ:
            (Path("/") / "no such folder" / "palette").read_text()
        return {"versions": {"squares": "1"}, "where": "here"}

    def make(self, split: str, index: int) -> Item:
        if os.environ.get("SQUARES_REFUSE") == f"{split}-{index}":
            raise RecordingError("this square cannot be made")
        if "SQUARES_LOG" in os.environ:
            (Path(os.environ["SQUARES_LOG"]) / f"{split}-{index}").touch()
        value = (self.seed + index + (100 if split == "extra" else 0)) % 256
        rgb = np.full((2, self.side, self.side, 3), value, np.uint8)
        return Item({"rgb": rgb, "value": np.float32(value)}, {"name": f"{split} {index}", "weight": index})

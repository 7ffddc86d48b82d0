"""Studies of APEX's two standard deviations, whose trials were logged to Weights & Biases."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from apex_lab.base.errors import UserError
from apex_lab.runs.identity import seed_folders, stored_configuration
from apex_lab.runs.state import read_state

KEYS = ("model.likelihood.sigma_fg", "model.likelihood.sigma_bg")
"""Of the objects and of the background."""


@dataclass(frozen=True)
class Study:
    """A study of both values.

    Attributes:
        name: of its folder.
        runs: names of its runs on Weights & Biases.
        score: name of the value that is drawn over the two.
        data, scale: words of its trials.
    """

    name: str
    runs: tuple[str, ...]
    score: str
    data: str
    scale: str


def studies(outputs: Iterable[Path]) -> list[Study]:
    """The studies in folders of runs whose trials vary both values and are on Weights & Biases."""
    found = []
    for folder in dict.fromkeys(outputs):
        try:
            inside = sorted(place for place in (folder / "studies").iterdir() if place.is_dir())
        except OSError:
            continue
        found += [study for place in inside if (study := _study(place)) is not None]
    return found


def _study(folder: Path) -> Study | None:
    runs: list[str] = []
    values: list[tuple[Any, ...]] = []
    record: dict[str, Any] = {}
    try:
        for place in seed_folders(folder):
            state = read_state(place)
            if "wandb_id" not in state.record:
                continue
            raw = stored_configuration(place)
            values.append(tuple(raw["model"]["likelihood"][key.rpartition(".")[2]] for key in KEYS))
            runs.append(f"{place.parent.name}_{place.name}")
            record = {**state.record, "split": raw["evaluation"]["split"]}
    except (UserError, OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return None  # trials of another model, or damaged
    if any(len(set(column)) < 2 for column in zip(*values, strict=True)) or not values:
        return None
    return Study(
        folder.name, tuple(runs), f"{record['split']}/ari_fg", str(record.get("data")), str(record.get("scale"))
    )

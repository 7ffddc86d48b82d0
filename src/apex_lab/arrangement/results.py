"""What a benchmark leaves behind: a file per scenario, and their summary as the paper's table."""

from __future__ import annotations

import hashlib
import json
import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import scipy

import sims
from apex_lab import inference, models, nn
from apex_lab import scene as contract
from apex_lab.arrangement.task import Setting, Task
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, write_json, write_text
from apex_lab.runs import provenance

RESULT = "arrangement.json"
"""Name of the summary; in a run folder it is what table 4 is made from."""

LOST_M = 1.0
"""The distance that an object counts with that is off the table (Section Object Arrangement Task)."""

Outcome = dict[str, Any]
"""As of a scenario's file."""


def identity(setting: Setting) -> str:
    """64 hex digits that are equal only if everything is equal that can change a scenario's outcome."""
    return _digest(
        {
            "perception": dict(setting.perception),
            "checkpoint": setting.digest,
            "device": setting.device,
            "world": setting.world.model_dump(mode="json"),
            "seed": setting.seed,
            "versions": {**provenance.versions(), "scipy": scipy.__version__, "opencv": cv2.__version__},
            "code": _code(),
        }
    )


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _code() -> str:
    """SHA-256 of the code that can change an outcome: the simulator, models and perception, no tests and no pages."""
    folders = [Path(package.__path__[0]) for package in (sims, models, nn, inference)]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    files += [Path(__file__).with_name("perception.py"), Path(contract.__file__)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


class Store:
    """The scenarios of one identity, each in a file of its own.

    Args:
        folder: where to; made if it is missing.
        key: of `identity`.

    Raises:
        UserError: the folder cannot be made.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = make_folder(folder), key
        self.scenarios, self.videos = make_folder(folder / "scenarios"), folder / "videos"

    def file(self, task: Task) -> Path:
        """Where the outcome of a scenario stands."""
        return self.scenarios / f"{task.objects}_{task.index:03d}.json"

    def film(self, task: Task) -> Path:
        """Where the video of a scenario stands."""
        return self.videos / f"{task.objects}_{task.index:03d}.mp4"

    def write(self, task: Task, outcome: Outcome) -> None:
        """Stores an outcome; the file is whole or not there.

        Raises:
            UserError: the disk is full.
        """
        write_json(self.file(task), {"identity": self.key, **outcome})

    def read(self, task: Task) -> Outcome | None:
        """A stored outcome; None where there is none, or it is damaged or of another identity."""
        file = self.file(task)
        if not file.exists():
            return None
        try:
            content = read_json(file)
            distances = [float(one["distance_m"]) for one in content["objects"]]
            whole = content["identity"] == self.key and len(distances) == task.objects == content["task"]
            return content if whole and content["index"] == task.index else None
        except (UserError, KeyError, TypeError, ValueError, OverflowError):
            return None


def summary(outcomes: Mapping[int, Sequence[Outcome]]) -> dict[str, Any]:
    """The content of arrangement.json that is made from outcomes.

    Returns:
        `distances_m`: number of objects -> scenarios -> distance of each object in metres. `tasks`: number of objects
        -> `scenarios`; `mean_m` and `std_m` (ddof = 1) over scenarios, each the mean of its objects; `median_m` over
        objects; `objects`; `lost` (off the table); `failures` (reason -> objects); `ended` (how episodes ended ->
        scenarios); `subtasks`; `without_retry` (sub-tasks that succeeded at the first attempt); `simulated_s` and
        `seconds` (processor time), means over scenarios.
    """
    return {
        "distances_m": {str(n): [_distances(one) for one in found] for n, found in sorted(outcomes.items())},
        "tasks": {str(n): _task(found) for n, found in sorted(outcomes.items())},
    }


def _distances(outcome: Outcome) -> list[float]:
    return [float(one["distance_m"]) for one in outcome["objects"]]


def _task(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    means = [math.fsum(_distances(one)) / len(one["objects"]) for one in outcomes]
    objects = [each for one in outcomes for each in one["objects"]]
    subtasks = [each for one in outcomes for each in one["subtasks"]]
    reasons = Counter(each["reason"] for each in objects if each["reason"] is not None)
    return {
        "scenarios": len(outcomes),
        "mean_m": statistics.fmean(means),
        "std_m": statistics.stdev(means) if len(means) > 1 else None,
        "median_m": statistics.median(each["distance_m"] for each in objects),
        "objects": len(objects),
        "lost": sum(each["distance_m"] >= LOST_M for each in objects),
        "failures": dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0]))),
        "ended": dict(Counter(one["ended"] for one in outcomes)),
        "subtasks": len(subtasks),
        "without_retry": sum(each["attempts"] == 1 and each["failure"] is None for each in subtasks),
        "simulated_s": statistics.fmean(one["time_s"] for one in outcomes),
        "seconds": statistics.fmean(one["seconds"] for one in outcomes),
    }


def table(title: str, found: Mapping[str, Any]) -> str:
    """A summary as Markdown.

    Args:
        title: what was arranged with.
        found: of `summary`.
    """
    lines = [
        f"{title}: distance to the goal in metres, mean ± standard deviation over scenarios",
        "",
        "| objects | scenarios | distance | median | at home | off the table | sub-tasks without retry | simulated |",
        "|---|---|---|---|---|---|---|---|",
    ]
    failures = []
    for number, task in found["tasks"].items():
        std = "" if task["std_m"] is None else f" ± {task['std_m']:.3f}"
        away = sum(task["failures"].values())
        home = f"{task['objects'] - away} of {task['objects']}"
        retry = f"{task['without_retry']} of {task['subtasks']}"
        cells = (number, task["scenarios"], f"{task['mean_m']:.3f}{std}", f"{task['median_m']:.3f}", home)
        row = (*cells, task["lost"], retry, f"{task['simulated_s']:.0f} s")
        lines.append(f"| {' | '.join(map(str, row))} |")
        if away:
            reasons = ", ".join(f"{reason} {count}" for reason, count in task["failures"].items())
            failures.append(f"- {number} objects, {away} of {task['objects']} away from home: {reasons}")
    return "\n".join([*lines, *(["", *failures] if failures else [])]) + "\n"


def write(folder: Path, title: str, found: Mapping[str, Any]) -> list[Path]:
    """Writes a summary as arrangement.json and arrangement.md.

    Returns:
        The files.

    Raises:
        UserError: the folder cannot be written.
    """
    paths = [folder / RESULT, folder / "arrangement.md"]
    write_json(paths[0], found)
    write_text(paths[1], table(title, found))
    return paths

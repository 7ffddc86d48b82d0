"""What a run folder holds: a seed with its state and scores, and a sentence for every file that cannot be read."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
from pydantic import BaseModel, ConfigDict

from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.validation import sentence, shown, validate
from apex_lab.metrics import KEYS
from apex_lab.runs.record import read_record

MIN_SHARE, MAX_SHARE = 0.001, 0.999
"""A seed has failed whose objects are given less or more of the validation pixels (metrics.md section 3)."""

DIVERGED = re.compile(r"\(not finite: ")
"""How the learner's message is known that a loss was not finite."""

SPLIT = "test"
"""What tables are made from."""

State = Literal["finished", "unfinished", "diverged", "damaged"]


class Record(BaseModel):
    """The entries of run.json that tables need."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)

    status: Literal["running", "paused", "finished", "failed"]
    format: int = 1
    seed: int
    reason: str | None = None
    outcome: str | None = None
    fingerprint: str | None = None
    data_fingerprint: str | None = None
    foreground_share: float | None = None


@dataclass(frozen=True)
class Protocol:
    """What must be equal for two scores to be compared: the videos, and how they were scored."""

    data_fingerprint: str | None
    videos: int | None
    frames: int | None
    scoring: str


@dataclass(frozen=True)
class SeedRun:
    """One run folder.

    Attributes:
        folder: outputs/<group>/seed_<n>.
        seed: n.
        record: content of run.json; None where it cannot be read.
        state: finished with scores; unfinished; diverged (training ended with a loss that was not finite); damaged.
        why: the remark on a run that has not finished.
        scores: key of `apex_lab.metrics.KEYS` -> value on the test split, NaN where undefined.
        protocol: of the scores.
        share: mean share of validation pixels given to objects at the end of training; None where it is not known.
    """

    folder: Path
    seed: int
    record: Record | None
    state: State
    why: str | None = None
    scores: Mapping[str, float] = field(default_factory=dict)
    protocol: Protocol | None = None
    share: float | None = None

    @property
    def failure(self) -> str | None:
        """Why this seed has failed by the rule of metrics.md section 3, which sees validation data alone; else None."""
        if self.state == "diverged":
            return "its loss was not finite"
        if self.share is not None and not MIN_SHARE <= self.share <= MAX_SHARE:
            return f"it gives {100 * self.share:.3f} % of the validation pixels to objects"
        return None


def read_run(folder: Path, seed: int, known: Mapping[str, Any] | None = None) -> SeedRun | None:
    """Reads one run folder; damage becomes a state, never an exception. None where there is no folder.

    Args:
        folder: of the run.
        seed: its seed.
        known: content of run.json, where it was read before.
    """
    if not known and not folder.exists():
        return None
    try:
        record = _record(folder / "run.json", seed, known)
    except UserError as error:
        return SeedRun(folder, seed, None, "damaged", str(error))
    if record.status != "finished":
        # runs of format 1 have no outcome: their reason tells
        diverged = record.outcome == "diverged" or (
            record.outcome is None and record.status == "failed" and DIVERGED.search(record.reason or "") is not None
        )
        why = f"its last word is: {sentence(record.reason)}" if record.reason else f"its status is '{record.status}'."
        return SeedRun(folder, seed, record, "diverged" if diverged else "unfinished", why)
    try:
        return _finished(folder, record)
    except UserError as error:
        return SeedRun(folder, seed, record, "damaged", str(error))


def read_arrangement(run: SeedRun) -> dict[str, list[list[float]]] | None:
    """The results of the arrangement task of one run; None where it has none.

    arrangement.json holds, under `distances_m`, for each number of objects ("2", "3", "4") a list of scenarios, and for
    each scenario the distance of every object to its goal in metres at the end; an object that fell off the table
    counts as 1 (Section Object Arrangement Task), one that cannot be measured is null.

    Returns:
        Number of objects -> scenarios -> the distance of every object, NaN for null.

    Raises:
        UserError: the file is damaged.
    """
    file = run.folder / "arrangement.json"
    if not file.exists():
        return None
    tasks = read_json(file).get("distances_m")
    if not isinstance(tasks, dict):
        raise UserError(f"{file} has no 'distances_m': remove it and arrange again.")
    found: dict[str, list[list[float]]] = {}
    for objects, scenarios in tasks.items():
        if not re.fullmatch("[1-9][0-9]{0,3}", objects) or not isinstance(scenarios, list):
            raise UserError(
                f"{file}: distances_m.{objects} is wrong: a list of scenarios per number of objects is wanted."
            )
        found[objects] = []
        for number, scenario in enumerate(scenarios):
            if not isinstance(scenario, list) or len(scenario) != int(objects):
                raise UserError(f"{file}: scenario {number} of distances_m.{objects} needs {objects} distances.")
            found[objects].append([_number(value, file, f"distances_m.{objects}") for value in scenario])
    return found


def read_failures(run: SeedRun) -> dict[str, tuple[int, int, dict[str, int]]]:
    """Why objects are not at their goals at the end, by number of objects; none where the file does not tell.

    Returns:
        Number of objects -> how many are away, of how many, and how many for each reason.
    """
    tasks = read_json(run.folder / "arrangement.json").get("tasks")
    found = {}
    for objects, task in tasks.items() if isinstance(tasks, dict) else ():
        try:
            reasons = {str(reason): int(count) for reason, count in task["failures"].items()}
            found[str(objects)] = (sum(reasons.values()), int(task["objects"]), reasons)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            continue
    return found


def _record(file: Path, seed: int, known: Mapping[str, Any] | None) -> Record:
    if not known and not file.is_file():
        raise UserError(f"{file} is missing: run the command of this run again.")
    content = known or read_record(file)
    try:
        record = validate(Record, content, "")
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    assert isinstance(record, Record)
    if record.seed != seed:
        raise UserError(
            f"{file} is of seed {record.seed}, but its folder is {file.parent.name}: correct the folder's name."
        )
    return record


def _finished(folder: Path, record: Record) -> SeedRun:
    """A run with the test split's scores in total.

    The share of pixels given to objects is that of the last validation of training, else that of an evaluation of the
    whole validation split.
    """
    file = folder / "metrics.json"
    if not file.is_file():
        raise UserError(f"{file} is missing: run the command of this run again.")
    content = _results(file)
    splits = content.get("splits")
    if not isinstance(splits, dict) or not splits:
        raise UserError(f"{file} has no 'splits': remove it and run the same command again.")
    scored = splits.get(SPLIT)
    if not isinstance(scored, dict):
        raise UserError(
            f"{file} has no scores of the split '{SPLIT}' (it has {', '.join(splits)}): evaluate that split."
        )
    total = scored.get("total")
    if not isinstance(total, dict):
        raise UserError(f"{file} has no 'splits.{SPLIT}.total': remove it and run the same command again.")
    scores = {key: _number(total[key], file, f"splits.{SPLIT}.total.{key}") for key in KEYS if key in total}
    videos, frames = (_size(scored.get(key, total.get(key)), file, key) for key in ("videos", "frames"))
    data = scored.get("data_fingerprint", record.data_fingerprint)
    protocol = Protocol(None if data is None else str(data), videos, frames, _scoring(scored, content))
    share = record.foreground_share
    validation = splits.get("val")
    if share is None and isinstance(validation, dict):
        share = _number(validation.get("foreground_share"), file, "splits.val.foreground_share")
    known = share is not None and math.isfinite(share)
    return SeedRun(folder, record.seed, record, "finished", None, scores, protocol, share if known else None)


class _Split(msgspec.Struct):
    """What tables need of a split; the rows per video, which are nearly all of the file, are not even built."""

    total: Any = msgspec.UNSET
    videos: Any = msgspec.UNSET
    frames: Any = msgspec.UNSET
    settings: Any = msgspec.UNSET
    foreground_share: Any = msgspec.UNSET
    data_fingerprint: Any = msgspec.UNSET


class _Results(msgspec.Struct):
    """What tables need of metrics.json."""

    splits: dict[str, _Split] | None = None
    settings: Any = msgspec.UNSET


_DECODER = msgspec.json.Decoder(_Results)


def _results(file: Path) -> dict[str, Any]:
    """Content of metrics.json without what tables do not need.

    Raises:
        UserError: it is damaged.
    """
    try:
        content: dict[str, Any] = msgspec.to_builtins(_DECODER.decode(file.read_bytes()))
        return content
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return read_json(file)  # of another shape, with NaN, or damaged: told as everywhere


def _scoring(scored: Mapping[str, Any], content: Mapping[str, Any]) -> str:
    """How a split was scored, in one line; models with and without identities of their own are scored alike."""
    settings = scored.get("settings", content.get("settings"))
    scoring = settings.get("scoring") if isinstance(settings, dict) else None
    if isinstance(scoring, dict) and scoring.get("identities") in ("own", "none"):
        scoring = {key: value for key, value in scoring.items() if key != "identities"}
    if isinstance(scoring, dict) and scoring.get("masks") == "model":  # what earlier versions did without saying so
        scoring = {key: value for key, value in scoring.items() if key != "masks"}
    if isinstance(scoring, dict) and scoring.get("resize") == "masks":  # likewise
        scoring = {key: value for key, value in scoring.items() if key != "resize"}
    if isinstance(scoring, dict) and scoring.get("first_frame") == 0:  # likewise
        scoring = {key: value for key, value in scoring.items() if key != "first_frame"}
    return json.dumps(scoring, sort_keys=True)


def _number(value: Any, file: Path, key: str) -> float:
    """A number of a JSON file; NaN for null and for what is not finite."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{file}: {key} = {shown(value)} is no number: remove the file and run the same command again.")
    try:
        number = float(value)
    except OverflowError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def _size(value: Any, file: Path, key: str) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise UserError(f"{file}: {key} = {shown(value)} is no count: remove the file and run the same command again.")
    return value


def and_list(values: Sequence[object]) -> str:
    """ "1", "1 and 2", "1, 2 and 3"."""
    words = [str(value) for value in values]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)

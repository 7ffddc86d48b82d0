"""Which runs stand in a row: seeds of one configuration, on the same data, scored in the same way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from apex_lab.config.upgrades import EXCLUDED
from apex_lab.tables.found import Protocol, SeedRun, listed, run_words

T = TypeVar("T")

NAMING = ("model", "ablation", "data", "scale", "trainer")
"""Groups whose choice a run is named by, or that changes nothing that a run's fingerprint sees."""


@dataclass(frozen=True)
class Version:
    """What this version of the package can run.

    Attributes:
        models, ablations: the words there are.
        fingerprint: words of a command line -> fingerprint of the configuration; None where there is none.
        arrange: whether the arrangement task is there.
    """

    models: Collection[str]
    ablations: Collection[str]
    fingerprint: Callable[[Sequence[str]], str | None]
    arrange: bool = False

    def has(self, model: str, ablation: str | None) -> bool:
        """Whether a row can be run."""
        return model in self.models and (ablation is None or ablation in self.ablations)


@dataclass(frozen=True)
class Group:
    """The runs of one configuration.

    Attributes:
        name: of its folder.
        runs: seed -> run, for those with the same protocol and for those without results.
        left_out: seed -> why its results cannot stand beside the others.
        protocol: of the results; None where there are none.
        current: whether this version's command makes this configuration; None where that is unknown.
        changes: words of the command line that changed values.
    """

    name: str
    runs: dict[int, SeedRun]
    left_out: dict[int, str]
    protocol: Protocol | None
    current: bool | None
    changes: tuple[str, ...]

    @property
    def finished(self) -> int:
        """Number of seeds with results."""
        return sum(run.state == "finished" for run in self.runs.values())

    @property
    def started(self) -> str:
        """When its last run was started, as ISO 8601."""
        return max((run.record.started or "" for run in self.runs.values() if run.record), default="")


@dataclass(frozen=True)
class Choice:
    """The group of a row, if there is any, and the remark on the choice."""

    group: Group | None
    notes: tuple[str, ...] = ()


REASONS = (
    "it was asked for",
    "it has results",
    "it is what this version's command makes",
    "its command changes no value",
    "it has the most seeds with results",
    "it was started last",
    "its name comes last",
)
"""Why one of several configurations is taken; the first reason that tells them apart decides."""


def choose(
    runs: Iterable[SeedRun],
    row: tuple[str, str | None],
    data: str,
    scale: str,
    asked: Collection[str],
    version: Version,
) -> Choice:
    """Finds the runs of a row.

    Candidates are runs of the row's model and ablation on this data set and scale, without an experiment and with the
    recipe's own values, not tuned ones (such runs are taken where their folder is asked for). Those of one
    folder have one configuration; among several folders the first of `REASONS` that tells them apart decides. Seeds of
    the folder that saw other data, or were scored otherwise, than most of its seeds are left out.

    Args:
        runs: all runs found.
        row: model and ablation.
        data: word of the data set.
        scale: word of the scale.
        asked: names of folders that are to be taken.
        version: what this version can run.
    """
    words = run_words(*row, data, scale)
    folders: dict[str, list[SeedRun]] = {}
    for run in runs:
        fits = run.words == words and (run.record is None or _named(run) == (*row, data, scale))
        other = run.record is not None and (run.record.experiment is not None or run.record.tuned is not None)
        if fits and (not other or run.group in asked):
            folders.setdefault(run.group, []).append(run)
    if not folders:
        return Choice(None)
    known = version.has(*row)
    fingerprint = version.fingerprint(command_words(*row, data, scale)) if known else None
    groups = [_group(name, members, fingerprint) for name, members in folders.items()]
    ranked = sorted(groups, key=lambda group: _rank(group, asked), reverse=True)
    best = ranked[0]
    notes = []
    if len(ranked) > 1:
        pairs = zip(_rank(best, asked), _rank(ranked[1], asked), REASONS, strict=True)
        reason = next(text for a, b, text in pairs if a != b)
        others = listed([group.name for group in ranked[1:]])
        notes.append(f"{len(ranked)} configurations fit: {best.name} is taken because {reason}; not {others}.")
    if best.changes and not best.current:
        notes.append(f"its command changed values: {' '.join(best.changes)}.")
    elif best.current is False:
        notes.append("its configuration is not the one that this version's command makes.")
    notes += [f"seed {seed} is left out: {why}" for seed, why in sorted(best.left_out.items())]
    return Choice(best, tuple(notes))


def command_words(model: str, ablation: str | None, data: str, scale: str) -> list[str]:
    """The words after `python -m apex_lab.train` that choose a run."""
    return [
        f"model={model}",
        *([f"+ablation={ablation}"] if ablation else []),
        *([f"data={data}"] if data != "p2d" else []),
        f"scale={scale}",
    ]


def _named(run: SeedRun) -> tuple[str | None, ...]:
    record = run.record
    assert record is not None
    return record.model, record.ablation, record.data, record.scale


def _rank(group: Group, asked: Collection[str]) -> tuple[object, ...]:
    return (
        group.name in asked,
        group.finished > 0,
        group.current is True,
        not group.changes,
        group.finished,
        group.started,
        group.name,
    )


def _group(name: str, members: Sequence[SeedRun], expected: str | None) -> Group:
    """Those of a folder's runs that can stand in one row."""
    prints = Counter(run.record.fingerprint for run in members if run.record)
    configuration = _most_common(prints)
    protocols = Counter(
        r.protocol for r in members if r.protocol and r.record and r.record.fingerprint == configuration
    )
    protocol = _most_common(protocols)
    runs, left_out = {}, {}
    for run in members:
        if run.record and run.record.fingerprint != configuration:
            left_out[run.seed] = "its configuration is another one than its folder's other seeds have."
        elif run.protocol and protocol and run.protocol != protocol:
            left_out[run.seed] = f"{difference(run.protocol, protocol)} than for the other seeds."
        else:
            runs[run.seed] = run
    current = None if expected is None or configuration is None else configuration == expected
    return Group(name, runs, left_out, protocol, current, _changes(runs.values()))


def _most_common(counts: Counter[T]) -> T | None:
    """The most frequent; among several the first in the order of their texts."""
    return min(counts, key=lambda value: (-counts[value], str(value))) if counts else None


def difference(one: Protocol, other: Protocol) -> str:
    """What differs, as "other data (fingerprint 12345678)"."""
    if one.data_fingerprint != other.data_fingerprint:
        return f"other data (fingerprint {(one.data_fingerprint or 'unknown')[:8]})"
    if (one.videos, one.frames) != (other.videos, other.frames):
        return f"other videos ({one.videos} with {one.frames} frames)"
    return "other settings of the evaluation"


def _changes(runs: Iterable[SeedRun]) -> tuple[str, ...]:
    """Words that changed values, of the first run that has any."""
    for run in runs:
        words = [word for word in (run.record.overrides if run.record else ()) if not _harmless(word)]
        if words:
            return tuple(words)
    return ()


def _harmless(word: str) -> bool:
    """Whether a word chooses what a run is named by, or something that cannot change a result."""
    key = word.split("=", 1)[0].lstrip("+~")
    return key in NAMING or any(key == name or key.startswith(f"{name}.") for name in (*EXCLUDED, "hydra"))

"""The configurations of a command's jobs, each with its seeds: what stands in one row of a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from apex_lab.config.composition import SHORT
from apex_lab.config.upgrades import FORMAT
from apex_lab.runs.listed import Listed
from apex_lab.tables.found import Protocol, SeedRun, read_run

T = TypeVar("T")

SCALE = "paper"
"""Of the paper; rows of others say so."""

_SHORT = {group: name for name, group in SHORT.items()}


@dataclass(frozen=True)
class Configuration:
    """The jobs of one configuration.

    Attributes:
        name: of its folder, as this version names it.
        model, ablation, data, scale: the words chosen for it.
        changes: further words that make it another one than those four do; without the + of the command line.
        jobs: seed -> the words of its job.
        folders: seed -> where its run is or will be.
        runs: seed -> run, for those with the same protocol and for those without results.
        left_out: seed -> why its results cannot stand beside the others.
        protocol: of the results; None where there are none.
    """

    name: str
    model: str
    ablation: str | None
    data: str
    scale: str
    changes: tuple[str, ...]
    jobs: Mapping[int, tuple[str, ...]]
    folders: Mapping[int, Path]
    runs: Mapping[int, SeedRun]
    left_out: Mapping[int, str]
    protocol: Protocol | None

    @property
    def row(self) -> tuple[str, str | None]:
        """What the specification of a table names a row by."""
        return self.model, self.ablation

    @property
    def seeds(self) -> tuple[int, ...]:
        """Those that are asked for."""
        return tuple(self.jobs)

    def told(self, usual: str) -> tuple[str, ...]:
        """Words that say how it differs from what the paper ran.

        Args:
            usual: the paper's data.
        """
        data = [f"data={self.data}"] if self.data != usual else []
        scale = [f"scale={self.scale}"] if self.scale != SCALE else []
        return (*data, *scale, *self.changes)

    @property
    def folder(self) -> str:
        """Name of the folder where its runs lie."""
        return next((run.folder.parent.name for run in self.runs.values()), self.name)


def configurations(jobs: Iterable[Listed], plain: Mapping[tuple[str, ...], str]) -> list[Configuration]:
    """The configurations of jobs in the order of their first job, with their runs read.

    Seeds that saw other data, or were scored otherwise, than most seeds of their configuration are left out.

    Args:
        jobs: of the command.
        plain: words of `plain_words` -> fingerprint of the configuration that they make.
    """
    together: dict[str, list[Listed]] = {}
    for job in jobs:
        together.setdefault(job.name, []).append(job)
    return [_configuration(name, members, plain) for name, members in together.items()]


def plain_words(job: Listed) -> tuple[str, ...]:
    """The words that choose a job's model, ablation, data and scale, and nothing else."""
    given = job.choices
    ablation = [f"+ablation={given['ablation']}"] if "ablation" in given else []
    return (f"model={given['model']}", *ablation, f"data={given['data']}", f"scale={given['scale']}")


def _configuration(name: str, jobs: Sequence[Listed], plain: Mapping[tuple[str, ...], str]) -> Configuration:
    first = jobs[0]
    changes = tuple(_short(word) for word in first.changes)
    if changes and first.fingerprint == plain.get(plain_words(first)):
        changes = ()  # the values are those that it has anyway
    runs: dict[int, SeedRun] = {}
    left_out: dict[int, str] = {}
    for job in jobs:
        run = read_run(job.folder, job.seed, job.state.record)
        if run is None:
            continue
        if run.record is not None and run.record.format == FORMAT and run.record.fingerprint != first.fingerprint:
            left_out[job.seed] = f"{job.folder} holds another configuration than its name tells."
        else:
            runs[job.seed] = run
    protocol = _most_common(Counter(run.protocol for run in runs.values() if run.protocol))
    for seed, run in list(runs.items()):
        if run.protocol and protocol and run.protocol != protocol:
            left_out[seed] = f"{difference(run.protocol, protocol)} than for the other seeds."
            runs.pop(seed)
    choices = first.choices
    return Configuration(
        name=name,
        model=choices["model"],
        ablation=choices.get("ablation"),
        data=choices["data"],
        scale=choices["scale"],
        changes=changes,
        jobs={job.seed: job.words for job in jobs},
        folders={job.seed: job.folder for job in jobs},
        runs=runs,
        left_out=left_out,
        protocol=protocol,
    )


def _short(word: str) -> str:
    key, equals, value = word.lstrip("+").partition("=")
    return f"{_SHORT.get(key, key)}{equals}{value}"


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

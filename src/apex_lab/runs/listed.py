"""The jobs of a command line with their runs, for commands that read what runs left behind. Imports no PyTorch.

`status`, `tables` and `report` are asked in the words of `apex_lab.train`: a job is the run of the configuration that
its words make, found by its fingerprint, or not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from apex_lab.config import preflight
from apex_lab.config.composition import folder_of_runs
from apex_lab.config.upgrades import EXCLUDED
from apex_lab.runs.identity import Outputs, group_name, run_folder
from apex_lab.runs.state import RunState, read_state


@dataclass(frozen=True)
class Listed:
    """One job and its run.

    Attributes:
        words: its overrides.
        raw: its resolved configuration.
        choices: group -> the word chosen for it.
        fingerprint: identity of its configuration, common to all seeds.
        state: of its run; `state.state` is "waiting" where there is none.
    """

    words: tuple[str, ...]
    raw: dict[str, Any]
    choices: dict[str, str]
    fingerprint: str
    state: RunState

    @property
    def folder(self) -> Path:
        """Of its run; need not exist."""
        return self.state.folder

    @property
    def seed(self) -> int:
        """Its seed."""
        return int(self.raw["seed"])

    @property
    def name(self) -> str:
        """Name of its configuration; its folder has another one where an older version began it."""
        return group_name(self.fingerprint, self.choices)

    @property
    def changes(self) -> tuple[str, ...]:
        """Those of its words that can change a result, besides model, ablation, data, scale and seed."""
        return tuple(word for word in self.words if _changes(word))

    def again(self) -> Listed:
        """The same job as it stands now."""
        return replace(self, state=read_state(self.folder))


def listed(words: Sequence[str], config_dir: str | None = None) -> list[Listed]:
    """Every job of a command line, in its order; several words that make one run make one job.

    Args:
        words: as after `python -m apex_lab.train`; several values and `+sweep=` as with `-m`.
        config_dir: a further folder of configuration files (`--config-dir`).

    Raises:
        UserError: words that Hydra refuses, or that no run can have; one sentence.
    """
    found: dict[Path, Listed] = {}
    outputs: dict[Path, Outputs] = {}
    for made in preflight.listed(words, config_dir):
        paths = made.raw.get("paths")
        where = folder_of_runs(paths.get("outputs") if isinstance(paths, dict) else paths)
        place = outputs.setdefault(where, Outputs(where))
        folder = run_folder(place, made.identity, made.choices, made.raw["seed"])
        if folder not in found:  # jobs may differ in words that change no result
            found[folder] = Listed(made.words, made.raw, made.choices, made.identity, read_state(folder))
    _check_unstarted(list(found.values()))
    return list(found.values())


def _check_unstarted(jobs: Sequence[Listed]) -> None:
    """Checks values that no run has been started with: a wrong one would look like a run that is still to come.

    One job is checked for each set of words that changes values, since the check builds the model.
    """
    started = {job.changes for job in jobs if job.state.state != "waiting"}
    checked: set[tuple[str, ...]] = set()
    for job in jobs:
        unseen = bool(job.changes) and job.changes not in started | checked
        if unseen or not isinstance(job.raw["seed"], int) or job.raw["seed"] < 0:
            preflight.check_training(job.raw, job.choices, job.words)
            checked.add(job.changes)


def _changes(word: str) -> bool:
    key = word.partition("=")[0].lstrip("+~")
    named = ("model", "ablation", "data", "scale", "seed", "trainer", "hydra", *EXCLUDED)
    return key not in named and not any(key.startswith(f"{name}.") for name in ("hydra", *EXCLUDED))

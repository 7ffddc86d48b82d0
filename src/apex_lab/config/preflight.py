"""The words of a command line, checked and composed before anything starts.

Entry points that start runs use this before Hydra does (`apex_lab.config.command_line`); those that read what runs left
behind use it alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.validation import did_you_mean, sentence, to_open
from apex_lab.config.composition import CHOICES, Composed, composed, composing, full_names, not_there, told
from apex_lab.config.job_list import expand, sweeps, tables_of
from apex_lab.config.options import at_home, options

Check = Callable[[dict[str, Any], dict[str, str], Sequence[str]], Any]
"""(plain configuration, group -> word, overrides) -> a checked job; raises UserError."""

MANY = 200
"""Jobs from which on looking for their runs takes seconds, so that it is announced."""


def listed(overrides: Sequence[str], config_dir: str | None = None) -> list[Composed]:
    """Composes every job that `apex_lab.train` would start with `-m`, for commands that read what runs left behind.

    Values are not checked (that needs PyTorch): `apex_lab.config.job.check_job` does that.

    Args:
        overrides: the words of the command.
        config_dir: a further folder of configuration files.

    Raises:
        UserError: what Hydra refuses, in one sentence.
    """
    overrides, extra = [at_home(word) for word in full_names(overrides)], search_path(config_dir)
    with composing(overrides):
        check_hydra_keys("train", extra, overrides)
        check_groups("train", overrides)
        jobs = expand([*swept_by_files("train", extra, overrides), *overrides], extra)
        if len(jobs) >= MANY:
            console.put(f"{len(jobs)} jobs: looking for their runs\n", error=True)
        return list(composed_jobs(check_training, "train", extra, jobs))


def sweep_tables(overrides: Sequence[str], config_dir: str | None = None) -> list[int] | None:
    """Numbers of the tables that the sweeps of a command make; None where a sweep names none.

    Raises:
        UserError: a sweep is not there.
    """
    with composing(overrides):
        return tables_of(sweeps(overrides), search_path(config_dir))


def plain_fingerprints(jobs: Sequence[tuple[str, ...]], config_dir: str | None = None) -> list[str]:
    """The identity of the configuration that each list of words makes.

    Raises:
        UserError: words that Hydra refuses.
    """
    with composing([word for job in jobs for word in job]):
        return [made.identity for made in composed("train", jobs, search_path(config_dir))]


def check_training(raw: dict[str, Any], choices: Mapping[str, str], words: Sequence[str]) -> Any:
    """`apex_lab.config.job.check_job`, imported when it is needed.

    Raises:
        UserError: what is wrong, in one sentence.
    """
    from apex_lab.config.job import check_job  # imports PyTorch, which most commands that read runs never need

    return check_job(raw, choices, words)


def search_path(config_dir: str | None) -> list[str]:
    """The override that makes Hydra look into the folder given as `--config-dir`."""
    if config_dir is None:
        return []
    if not to_open("--config-dir", config_dir).is_dir():
        raise UserError(f"--config-dir {config_dir} is not a folder.")
    return [f"hydra.searchpath=[file://{Path(config_dir).resolve()}]"]


def asks_for_sweep(name: str, extra: Sequence[str], overrides: Sequence[str]) -> bool:
    """Whether `hydra.mode`, in a word or in the file of an experiment, asks for what `-m` asks for."""
    keys = {o.key_or_group: o for o in OverridesParser.create().parse_overrides(list(overrides))}
    if "hydra.mode" not in keys and "experiment" not in keys:
        return False
    config = compose(name, overrides=[*extra, *of_all_jobs(overrides)], return_hydra_config=True)
    return getattr(config.hydra.mode, "name", None) == "MULTIRUN"


def swept_by_files(name: str, extra: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """What configuration files sweep by `hydra.sweeper.params`, as words of a command line."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    groups = [str(o.input_line) for o in parsed if o.key_or_group in CHOICES and not o.is_sweep_override()]
    config = compose(name, overrides=[*extra, *groups], return_hydra_config=True)
    return [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]


def of_all_jobs(overrides: Sequence[str]) -> list[str]:
    """Those words of a sweep that say how its jobs are launched, or choose files that may say so."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    mine = ("hydra.", "hydra/", "paths.")
    return [
        str(o.input_line)
        for o in parsed
        if not o.is_sweep_override() and (o.key_or_group in (*CHOICES, "paths") or o.key_or_group.startswith(mine))
    ]


def job_of(name: str, words: Sequence[str], check: Check) -> Any:
    """Composes another command's configuration and checks it; to be called while an entry point runs.

    A folder given as `--config-dir` is searched too.

    Args:
        name: file in conf/ without its ending.
        words: overrides.
        check: turns a composed configuration into a job.

    Raises:
        UserError: what Hydra or the check refuses, in one sentence.
    """
    extra = search_path(options().config_dir)
    try:
        (made,) = composed_jobs(check, name, extra, [tuple(words)])
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(told(error, words)) from error
    return check(made.raw, made.choices, made.words)


def composed_jobs(check: Check, name: str, extra: Sequence[str], jobs: Sequence[tuple[str, ...]]) -> Iterator[Composed]:
    """Composes jobs; the sentence on a key that no file sets says whether it exists and what is close to it."""
    try:
        yield from composed(name, jobs, extra)
    except HydraException as error:
        key = not_there(error)
        if key is None:
            raise
        job = next(job for job in jobs if any(word.startswith(f"{key}=") for word in job))
        # Hydra only knows that no file sets the key; the check knows whether it exists
        added = [f"++{word}" if word.startswith(f"{key}=") else word for word in job]
        for made in composed(name, [added], extra):
            check(made.raw, made.choices, made.words)
        word = next(word for word in job if word.startswith(f"{key}="))
        raise UserError(f"{key} is set by no file that was chosen: write ++{word} to add it.") from error


_FREE = (
    "hydra.job.env_set.",
    "hydra.sweeper.params.",
    "hydra.launcher.ray.",
    "hydra.launcher.additional_parameters.",  # submitit's, for Slurm
)
"""Keys of Hydra's own configuration whose names its user chooses."""


def check_hydra_keys(name: str, extra: Sequence[str], overrides: Sequence[str]) -> None:
    """Refuses keys that Hydra's own configuration does not have; `+` and `++` would add them without a word."""
    added = [word for word in overrides if re.match(r"\+{0,2}hydra\.", word) and not word.lstrip("+").startswith(_FREE)]
    if not added:
        return
    groups = [word for word in overrides if word.startswith("hydra/")]
    known = compose(name, overrides=[*extra, *groups], return_hydra_config=True)
    for word in added:
        key = word.lstrip("+").split("=", 1)[0]
        parent, _, last = key.rpartition(".")
        siblings = OmegaConf.select(known, parent, default={})
        if last not in siblings:
            raise UserError(sentence(f"Unknown key {word.lstrip('+')}{did_you_mean(last, map(str, siblings))}"))


def check_launcher(name: str, extra: Sequence[str], overrides: Sequence[str]) -> None:
    """Refuses a launcher that is not there, keys that it does not have, and what jobs cannot be launched with."""
    ours = ("hydra/launcher", "hydra.launcher", "hydra/sweeper", "hydra.sweeper")
    words = [word for word in overrides if word.lstrip("+~").startswith(ours)]
    if not words:
        return
    hydra_part = compose(name, overrides=[*extra, *words], return_hydra_config=True).hydra
    for part in ("launcher", "sweeper"):
        target = str(hydra_part[part].get("_target_"))
        if not target.startswith(("hydra_plugins.", "hydra._internal.")):
            raise UserError(f"hydra.{part}._target_={target} is no {part} of Hydra: choose one by hydra/{part}=...")
    for key in ("tasks_per_node", "nodes"):
        if hydra_part.launcher.get(key, 1) != 1:
            raise UserError(
                f"hydra.launcher.{key}={hydra_part.launcher[key]}: a job is one task on one machine, which starts the "
                "other processes of trainer.devices itself; for several machines use torchrun (docs/clusters.md)."
            )
    slots = hydra_part.sweeper.get("slots")
    if slots is not None and slots < 1:
        raise UserError(f"hydra.sweeper.slots={slots}: give the number of jobs that a machine does at once, or null.")
    jobs = hydra_part.launcher.get("n_jobs")
    if jobs == 0:
        raise UserError("hydra.launcher.n_jobs=0: give the number of jobs at once, or -1 for one on each core.")


def check_groups(command: str, overrides: Sequence[str]) -> None:
    """Refuses choices that a command does not have, and two of one thing in one run: Hydra would merge them into a run
    that no choice names.
    """
    if command not in ("train", "bench", "evaluate", "compare"):
        return
    given: dict[str, str] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if override.is_delete() and override.value() is None and key in ("model", "data", "scale", "trainer", "paths"):
            raise UserError(f"~{key} leaves no {key}, and every run has one: choose it by {key}=...")
        if key not in CHOICES or override.is_delete() or override.is_sweep_override():
            continue
        word = override.get_value_element_as_str()
        if command in ("evaluate", "compare") and key != "data":
            raise UserError(f"{key}={word} is for training: a checkpoint brings its own configuration; leave it out.")
        plus = "+" if override.is_add() else ""
        if isinstance(override.value(), list):
            raise UserError(
                f"{key}={word} puts several into one run: write {plus}{key}={word.strip('[]')} -m to run each."
            )
        if key in given and override.is_add():
            raise UserError(f"{key} is given twice: choose one, or write +{key}={given[key]},{word} -m to run each.")
        given[key] = word

"""From the words on the command line to checked jobs: what all entry points share.

Hydra composes and launches. Before it starts, every job of the command is composed and checked here, so that the third
of four jobs' misspelt value is found before the first one starts, `++` included.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra import compose
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apex_lab.base import attached, console, interrupts
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.base.validation import did_you_mean, one_line, sentence
from apex_lab.config import elsewhere
from apex_lab.config.composition import (
    CHOICES,
    Composed,
    chosen,
    composed,
    composing,
    conf_dir,
    full_names,
    not_there,
    plain,
    told,
)
from apex_lab.config.elsewhere import Origin
from apex_lab.config.job_list import expand, sweeps, tables_of
from apex_lab.config.sweeps import Item, JobBusy, JobFailed, Known, Sweep

Check = Callable[[dict[str, Any], dict[str, str], Sequence[str]], Any]
"""(plain configuration, group -> word, overrides) -> a checked job; raises UserError."""

CONFIG_ERROR = 2
RUN_ERROR = 1


@dataclass(frozen=True)
class Command:
    """What an entry point does.

    Attributes:
        config_name: file in conf/ without its ending.
        check: turns a composed configuration into a job.
        work: does one job; returns how it ended where that is not "finished" (`apex_lab.runs.folder.Outcome`).
        title: a job in a few words, for the list of what failed.
        known: the state of a job that was not started; None where jobs leave nothing behind that could be looked at.
        reseeded: the job of another seed of a checked configuration; None where seeds are checked like other jobs.
    """

    config_name: str
    check: Check
    work: Callable[[Any], str | None]
    title: Callable[[Any], str]
    known: Callable[[Any], Known] | None = None
    reseeded: Callable[[Any, Composed], Any] | None = None


def launch(command: Command) -> None:
    """Runs an entry point: checks every job of the command line, then runs them.

    A job that fails does not stop the next ones. Ends the process with exit code 0, 1 (a job failed), 2 (the command or
    its configuration is wrong; nothing was started) or 128 + n (stopped by signal n).
    """
    console.setup()
    attached.listen()
    ended: list[tuple[str, str | None]] = []  # of the job that is no sweep's

    def do(config: DictConfig) -> str:
        interrupts.check()
        overrides = list(HydraConfig.get().overrides.task)
        try:
            job = command.check(plain(config), chosen(HydraConfig.get().runtime), overrides)
            state = command.work(job) or "finished"
        except Busy as error:
            return end("busy", JobBusy(str(error)), str(error))
        except UserError as error:
            return end("failed", JobFailed(one_line(error)), str(error))
        except Exception as error:  # noqa: BLE001 - reported below; the other jobs of a sweep must still run
            traceback.print_exc()
            return end("failed", JobFailed(f"{type(error).__name__}: {one_line(error)}"))
        ended.append((state, None))
        return state

    def end(state: str, error: JobFailed | JobBusy, message: str | None = None) -> str:
        """Reports a failure to whoever has started the job."""
        swept = HydraConfig.get().mode == RunMode.MULTIRUN
        if message is not None and not (swept and state == "busy"):
            console.error(message)
        if swept:
            raise error  # comes back through Hydra's job return
        ended.append((state, str(error)))
        return state

    sys.argv[1:] = full_names(_options_last(sys.argv[1:]))
    if command.config_name == "evaluate":
        # the checkpoint brings the data's settings, so no file here has them; the check knows which exist
        sys.argv[1:] = [f"++{word}" if word.startswith("data.") else word for word in sys.argv[1:]]
    sweep = Sweep([], command.known)
    try:
        with interruptible():
            sweep.items = _preflight(command)
            jobs = [item.words for item in sweep.items]
            task = _Task(Origin.here(f"apex_lab.{command.config_name}", _options(), jobs), do, sweep)
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=command.config_name)(task)()
    except UserError as error:
        console.error(str(error))
        attached.tell("failed", one_line(error))
        sys.exit(CONFIG_ERROR)
    except Interrupted as stop:
        sweep.take_stock()
        sweep.report()
        console.error(f"Stopped by {stop}; the same command resumes from here.")
        attached.tell("interrupted", str(stop))
        sys.exit(128 + stop.signum)
    sweep.report()
    for state, reason in ended:
        attached.tell(state, reason)
    if sweep.failures or any(state in ("failed", "busy") for state, _ in ended):
        sys.exit(RUN_ERROR)
    if sweep.stopped is not None:
        sys.exit(128 + sweep.stopped)


@dataclass
class _Task:
    """What Hydra calls for each job, in this process or, by a launcher, in another.

    Attributes:
        origin: the process of the command.
        do: does a job in it.
        sweep: all jobs of the command; `hydra_plugins.apex_lab.sweeper` runs it.
    """

    origin: Origin
    do: Callable[[DictConfig], str] | None
    sweep: Sweep | None

    def __call__(self, config: DictConfig) -> str:
        if self.do is None:
            return elsewhere.run(self.origin)
        return self.do(config)

    def __reduce__(self) -> tuple[Any, ...]:
        """Other processes start the job as a command of its own, and need neither this one's objects nor its list."""
        return _Task, (self.origin, None, None)


def _options() -> list[str]:
    """The options of this command, besides its words, that each of its jobs needs."""
    arguments = get_args_parser().parse_args()
    options = []
    for name in ("config_dir", "config_path"):
        if (value := getattr(arguments, name)) is not None:
            options += [f"--{name.replace('_', '-')}", str(Path(value).absolute())]
    if arguments.config_name is not None:
        options += ["--config-name", arguments.config_name]
    return options


def _preflight(command: Command) -> list[Item]:
    """Composes and checks every job of the command line, unless it only asks for help or for the configuration.

    Returns:
        The jobs of a sweep; none where it is no sweep.

    Raises:
        UserError: what Hydra or the check refuses, in one sentence.
    """
    arguments = get_args_parser().parse_args()
    if arguments.multirun and (arguments.cfg or arguments.info):
        raise UserError("-m cannot stand beside --cfg or --info: leave it out to see one job's configuration.")
    if arguments.help or arguments.hydra_help or arguments.info or arguments.shell_completion or arguments.cfg:
        return []
    extra = _search_path(arguments.config_dir)
    name = arguments.config_name or command.config_name
    overrides = arguments.overrides
    with composing(overrides, arguments.config_path):
        _check_hydra_keys(name, extra, overrides)
        _check_groups(command.config_name, overrides)
        if not (arguments.multirun or "hydra.mode=MULTIRUN" in overrides):
            _checked(command, name, extra, [tuple(overrides)])
            return []
        _check_launcher(name, extra, overrides)
        if any(word.startswith("hydra/sweeper=") for word in overrides):
            return []  # another sweeper chooses its values as it goes; each of its jobs is checked when it starts
        jobs = expand([*_swept_by_files(name, extra, overrides), *overrides], extra)
        return _checked(command, name, extra, jobs)


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
    extra = _search_path(get_args_parser().parse_args().config_dir)
    try:
        (made,) = _composed(check, name, extra, [tuple(words)])
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(told(error, words)) from error
    return check(made.raw, made.choices, made.words)


def take_words(wanted: Callable[[str], bool]) -> tuple[list[str], str | None]:
    """Takes overrides out of this process's command line, before `launch` sees it.

    Args:
        wanted: key of an override, without + and ~ -> whether it is to be taken.

    Returns:
        The overrides, with the full names of groups, and the folder given as `--config-dir`.

    Raises:
        UserError: `-m` is among the options.
    """
    sys.argv[1:] = full_names(_options_last(sys.argv[1:]))
    arguments = get_args_parser().parse_args()
    if arguments.multirun:
        raise UserError("-m starts many runs, and this command starts its own: leave it out.")
    taken = [word for word in arguments.overrides if wanted(word.lstrip("+~").partition("=")[0])]
    for word in taken:
        sys.argv.remove(word)
    return taken, arguments.config_dir


def listed(overrides: Sequence[str], config_dir: str | None = None) -> list[Composed]:
    """Composes every job that `apex_lab.train` would start with `-m`, for commands that read what runs left behind.

    Values are not checked (that needs PyTorch): `apex_lab.config.schema.check_job` does that.

    Args:
        overrides: the words of the command.
        config_dir: a further folder of configuration files.

    Raises:
        UserError: what Hydra refuses, in one sentence.
    """
    overrides, extra = full_names(overrides), _search_path(config_dir)
    with composing(overrides):
        _check_hydra_keys("train", extra, overrides)
        _check_groups("train", overrides)
        jobs = expand([*_swept_by_files("train", extra, overrides), *overrides], extra)
        return list(_composed(check_training, "train", extra, jobs))


def sweep_tables(overrides: Sequence[str], config_dir: str | None = None) -> list[int] | None:
    """Numbers of the tables that the sweeps of a command make; None where a sweep names none.

    Raises:
        UserError: a sweep is not there.
    """
    with composing(overrides):
        return tables_of(sweeps(overrides), _search_path(config_dir))


def plain_fingerprints(jobs: Sequence[tuple[str, ...]], config_dir: str | None = None) -> list[str]:
    """The identity of the configuration that each list of words makes.

    Raises:
        UserError: words that Hydra refuses.
    """
    with composing([word for job in jobs for word in job]):
        return [made.identity for made in composed("train", jobs, _search_path(config_dir))]


def check_training(raw: dict[str, Any], choices: Mapping[str, str], words: Sequence[str]) -> Any:
    """`apex_lab.config.schema.check_job`, imported when it is needed.

    Raises:
        UserError: what is wrong, in one sentence.
    """
    from apex_lab.config.schema import check_job  # imports PyTorch, which most commands that read runs never need

    return check_job(raw, choices, words)


def _search_path(config_dir: str | None) -> list[str]:
    """The override that makes Hydra look into the folder given as `--config-dir`."""
    if config_dir is None:
        return []
    if not Path(config_dir).is_dir():
        raise UserError(f"--config-dir {config_dir} is not a folder.")
    return [f"hydra.searchpath=[file://{Path(config_dir).resolve()}]"]


def _swept_by_files(name: str, extra: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """What configuration files sweep by `hydra.sweeper.params`, as words of a command line."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    groups = [str(o.input_line) for o in parsed if o.key_or_group in CHOICES and not o.is_sweep_override()]
    config = compose(name, overrides=[*extra, *groups], return_hydra_config=True)
    return [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]


def _checked(command: Command, name: str, extra: Sequence[str], jobs: Sequence[tuple[str, ...]]) -> list[Item]:
    """Composes and checks jobs; one that only differs in its seed from another is not built again."""
    first: dict[tuple[str, ...], Any] = {}
    items = []
    for made in _composed(command.check, name, extra, jobs):
        rest = tuple(word for word in made.words if not word.startswith("seed="))
        if command.reseeded is None or rest not in first:
            first[rest] = command.check(made.raw, made.choices, made.words)
            job = first[rest]
        else:
            job = command.reseeded(first[rest], made)
        items.append(Item(made.words, job, command.title(job)))
    return items


def _composed(check: Check, name: str, extra: Sequence[str], jobs: Sequence[tuple[str, ...]]) -> Iterator[Composed]:
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


def _check_hydra_keys(name: str, extra: Sequence[str], overrides: Sequence[str]) -> None:
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


def _check_launcher(name: str, extra: Sequence[str], overrides: Sequence[str]) -> None:
    """Refuses a launcher that is not there, keys that it does not have, and what jobs cannot be launched with."""
    ours = ("hydra/launcher", "hydra.launcher", "hydra/sweeper", "hydra.sweeper")
    words = [word for word in overrides if word.lstrip("+~").startswith(ours)]
    if not words:
        return
    hydra_part = compose(name, overrides=[*extra, *words], return_hydra_config=True).hydra
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


def _check_groups(command: str, overrides: Sequence[str]) -> None:
    """Refuses choices that a command does not have, and two of one thing in one run: Hydra would merge them into a run
    that no choice names.
    """
    if command not in ("train", "bench", "evaluate"):
        return
    given: dict[str, str] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key not in CHOICES or override.is_delete() or override.is_sweep_override():
            continue
        word = override.get_value_element_as_str()
        if command == "evaluate" and key != "data":
            raise UserError(f"{key}={word} is for training: a checkpoint brings its own configuration; leave it out.")
        plus = "+" if override.is_add() else ""
        if isinstance(override.value(), list):
            raise UserError(
                f"{key}={word} puts several into one run: write {plus}{key}={word.strip('[]')} -m to run each."
            )
        if key in given and override.is_add():
            raise UserError(f"{key} is given twice: choose one, or write +{key}={given[key]},{word} -m to run each.")
        given[key] = word


def _options_last(arguments: Sequence[str]) -> list[str]:
    """The same command line with all overrides in one piece, so that `-m` may stand anywhere."""
    known, rest = get_args_parser().parse_known_args(list(arguments))
    late = [word for word in rest if not word.startswith("-")]
    if not late:
        return list(arguments)
    early = list(known.overrides)
    options = list(arguments)
    for word in [*early, *late]:
        options.remove(word)
    return [*early, *late, *options]


def command_line() -> str:
    """The command that started this process, as one can type it again."""
    program = Path(sys.argv[0])
    if program.suffix == ".py" and program.parent.name == "apex_lab":
        words = ["python", "-m", f"apex_lab.{program.stem}"]
    else:
        words = [os.path.basename(sys.argv[0])]
    return shlex.join([*words, *sys.argv[1:]])

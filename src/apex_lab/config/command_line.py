"""From the words on the command line to checked jobs: what all entry points share.

Hydra composes and launches. Before it starts, every job of the command is composed and checked here, so that the third
of four jobs' misspelt value is found before the first one starts, `++` included.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import version
from hydra._internal.utils import _run_hydra, get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from apex_lab.base import attached, console, faults, interrupts
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import unwritable
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.base.validation import one_line
from apex_lab.config import elsewhere
from apex_lab.config.composition import Composed, chosen, composing, conf_dir, needing_folders, plain, told
from apex_lab.config.elsewhere import Origin
from apex_lab.config.job_list import expand
from apex_lab.config.options import arrange, only_asks, options, passed_on
from apex_lab.config.preflight import (
    Check,
    asks_for_sweep,
    check_groups,
    check_hydra_keys,
    check_launcher,
    composed_jobs,
    of_all_jobs,
    search_path,
    swept_by_files,
)
from apex_lab.config.sweeps import Item, JobBusy, JobFailed, Known, Sweep

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
        literal: keys whose values are names of files, so that their commas, brackets and equals signs mean nothing to
            Hydra; lists in brackets and values in quotes are left to it.
        of_checkpoint: beginnings of words such as `data.` that are passed on though no file has such keys, since a
            checkpoint brings these settings; the check knows which exist.
        model_groups: the command composes models, so short names of their groups (`masks=scalor`) are understood.
        resumes: whether the same command goes on with a job that was stopped, so that this may be said.
    """

    config_name: str
    check: Check
    work: Callable[[Any], str | None]
    title: Callable[[Any], str]
    known: Callable[[Any], Known] | None = None
    reseeded: Callable[[Any, Composed], Any] | None = None
    literal: tuple[str, ...] = ()
    of_checkpoint: tuple[str, ...] = ()
    model_groups: bool = True
    resumes: Callable[[Any], bool] = lambda job: True


def launch(command: Command) -> None:
    """Runs an entry point: checks every job of the command line, then runs them.

    A job that fails does not stop the next ones. Ends the process with exit code 0, 1 (a job failed), 2 (the command or
    its configuration is wrong; nothing was started) or 128 + n (stopped by signal n).
    """
    console.setup()
    attached.listen()
    ended: list[tuple[str, str | None]] = []  # of the job that is no sweep's
    begun: list[Any] = []

    def do(config: DictConfig) -> str:
        """Checks and does a job in this process; how it ended."""
        interrupts.check()
        overrides = list(HydraConfig.get().overrides.task)
        try:
            job = command.check(plain(config), chosen(HydraConfig.get().runtime), overrides)
            begun.append(job)
            state = command.work(job) or "finished"
        except Busy as error:
            return end("busy", JobBusy(str(error)), str(error))
        except UserError as error:
            return end("failed", JobFailed(one_line(error)), str(error))
        except Exception as error:  # noqa: BLE001 - reported below; the other jobs of a sweep must still run
            return end("failed", JobFailed(faults.cited(error)), faults.told(error))
        ended.append((state, None))
        return state

    def end(state: str, error: JobFailed | JobBusy, message: str) -> str:
        """Reports a failure to whoever has started the job."""
        swept = HydraConfig.get().mode == RunMode.MULTIRUN
        if not (swept and state == "busy"):
            console.error(message)
        if swept:
            raise error  # comes back through Hydra's job return
        ended.append((state, str(error)))
        return state

    sweep = Sweep([], command.known)
    try:
        with faults.net(), interruptible():
            arrange(command.literal, command.model_groups)
            sys.argv[1:] = [f"++{word}" if word.startswith(command.of_checkpoint) else word for word in sys.argv[1:]]
            sweep.items = _preflight(command)
            jobs = [item.words for item in sweep.items]
            task = _Task(Origin.here(f"apex_lab.{command.config_name}", passed_on(), jobs), do, sweep)
            with _raising(), needing_folders():
                _hydra(task, command.config_name)
    except UserError as error:
        console.error(str(error))
        attached.tell("failed", one_line(error))
        sys.exit(CONFIG_ERROR)
    except Interrupted as stop:
        resumes = all(command.resumes(job) for job in (*begun, *(item.job for item in sweep.items)))
        sweep.take_stock()
        sweep.report(resumes)
        again = "resumes from here" if resumes else "begins from the start"
        console.error(f"Stopped by {stop}; the same command {again}.")
        attached.tell("interrupted", str(stop))
        sys.exit(128 + stop.signum)
    sweep.report()
    for state, reason in ended:
        attached.tell(state, reason)
    if sweep.failures or any(state in ("failed", "busy") for state, _ in ended):
        sys.exit(RUN_ERROR)
    if sweep.stopped is not None:
        sys.exit(128 + sweep.stopped)


def _hydra(task: _Task, name: str) -> None:
    """What `hydra.main` does, with the words that Hydra needs.

    Of a sweep that is expanded already, Hydra composes what is common to all jobs: it is left without the words that
    only some of them may fit.
    """
    version.setbase("1.3")
    asked = options()
    if task.sweep is not None and task.sweep.items:
        asked.overrides = of_all_jobs(asked.overrides)
    _run_hydra(asked, get_args_parser(), task, str(conf_dir()), name)


@contextlib.contextmanager
def _raising() -> Iterator[None]:
    """Inside, Hydra raises what it would print in many lines before it ends the process.

    Raises:
        UserError: Hydra or OmegaConf refused something, or cannot make its folder, in one sentence.
    """
    before = os.environ.get(_RAISES)
    os.environ[_RAISES] = "1"
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(told(error, options().overrides)) from error
    except OSError as error:  # what jobs raise does not come here
        folder = Path(os.fsdecode(error.filename or "."))
        raise UserError(f"hydra.run.dir or hydra.sweep.dir: {unwritable(folder, error)}") from error
    finally:
        if before is None:
            del os.environ[_RAISES]
        else:
            os.environ[_RAISES] = before


_RAISES = "HYDRA_FULL_ERROR"
"""The variable by which Hydra is asked to raise."""


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


def _preflight(command: Command) -> list[Item]:
    """Composes and checks every job of the command line, unless it only asks for help or for the configuration.

    Returns:
        The jobs of a sweep; none where it is no sweep.

    Raises:
        UserError: what Hydra or the check refuses, in one sentence.
    """
    arguments = options()
    if only_asks(arguments):
        return []
    extra = search_path(arguments.config_dir)
    name = arguments.config_name or command.config_name
    overrides = arguments.overrides
    with composing(overrides, arguments.config_path):
        check_hydra_keys(name, extra, overrides)
        check_groups(command.config_name, overrides)
        if not (arguments.multirun or asks_for_sweep(name, extra, overrides)):
            _checked(command, name, extra, [tuple(overrides)])
            return []
        check_launcher(name, extra, overrides)
        if any(word.startswith("hydra/sweeper=") for word in overrides):
            return []  # another sweeper chooses its values as it goes; each of its jobs is checked when it starts
        jobs = expand([*swept_by_files(name, extra, overrides), *overrides], extra)
        return _checked(command, name, extra, jobs)


def take_words(wanted: Callable[[str], bool]) -> tuple[list[str], str | None]:
    """Takes overrides out of this process's command line, before `launch` sees it.

    Args:
        wanted: key of an override, without + and ~ -> whether it is to be taken.

    Returns:
        The overrides, with the full names of groups, and the folder given as `--config-dir`.

    Raises:
        UserError: `-m` is among the options.
    """
    arrange()
    arguments = options()
    if arguments.multirun:
        raise UserError("-m starts many runs, and this command starts its own: leave it out.")
    taken = [word for word in arguments.overrides if wanted(word.lstrip("+~").partition("=")[0])]
    for word in taken:
        sys.argv.remove(word)
    return taken, arguments.config_dir


def _checked(command: Command, name: str, extra: Sequence[str], jobs: Sequence[tuple[str, ...]]) -> list[Item]:
    """Composes and checks jobs; one that only differs in its seed from another is not built again."""
    first: dict[tuple[str, ...], Any] = {}
    items = []
    for made in composed_jobs(command.check, name, extra, jobs):
        rest = tuple(word for word in made.words if not word.startswith("seed="))
        if command.reseeded is None or rest not in first:
            first[rest] = command.check(made.raw, made.choices, made.words)
            job = first[rest]
        else:
            job = command.reseeded(first[rest], made)
        items.append(Item(made.words, job, command.title(job)))
    return items


def command_line() -> str:
    """The command that started this process, as one can type it again."""
    program = Path(sys.argv[0])
    if program.suffix == ".py" and program.parent.name == "apex_lab":
        words = ["python", "-m", f"apex_lab.{program.stem}"]
    else:
        words = [os.path.basename(sys.argv[0])]
    return shlex.join([*words, *sys.argv[1:]])

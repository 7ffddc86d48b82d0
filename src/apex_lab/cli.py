"""From the words on the command line to checked jobs: what all entry points share.

Hydra composes, expands sweeps and launches. Before it starts, every job of the command is composed and checked here, so
that the third of four jobs' misspelt value is found before the first one starts, `++` included.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apex_lab import console
from apex_lab.components import did_you_mean, one_line
from apex_lab.config import conf_dir, plain
from apex_lab.errors import UserError

Check = Callable[[dict[str, Any], dict[str, str], Sequence[str]], Any]
"""(plain configuration, group -> word, overrides) -> a checked job; raises UserError."""

CONFIG_ERROR = 2
RUN_ERROR = 1


class Interrupted(BaseException):
    """Somebody asked the process to stop (Ctrl-C, SIGTERM); nothing is wrong."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum


def launch(config_name: str, check: Check, work: Callable[[Any], None], title: Callable[[Any], str]) -> None:
    """Runs an entry point: checks every job of the command line, then runs them one after another.

    A job that fails does not stop the next ones. Ends the process with exit code 0, 1 (a job failed), 2 (the command or
    its configuration is wrong; nothing was started) or 128 + n (stopped by signal n).

    Args:
        config_name: file in conf/ without its ending.
        check: turns a composed configuration into a job.
        work: does one job.
        title: a job in a few words, for the list of what failed.
    """
    console.setup()
    failures: list[tuple[str, str]] = []

    def task(config: DictConfig) -> None:
        overrides = list(HydraConfig.get().overrides.task)
        name = " ".join(overrides)
        try:
            job = check(plain(config), _choices(HydraConfig.get().runtime.choices), overrides)
            name = title(job)
            work(job)
        except UserError as error:
            console.error(str(error))
            failures.append((name, one_line(error)))
        except Exception as error:  # noqa: BLE001 - told below; the other jobs of a sweep must still run
            traceback.print_exc()
            failures.append((name, f"{type(error).__name__}: {one_line(error)}"))

    sys.argv[1:] = _options_last(sys.argv[1:])
    try:
        with _interruptible():
            _preflight(config_name, check)
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(task)()
    except UserError as error:
        console.error(str(error))
        sys.exit(CONFIG_ERROR)
    except Interrupted as stop:
        console.error(f"Stopped by {stop}; the same command goes on from here.")
        sys.exit(128 + stop.signum)
    if failures:
        console.error(f"{len(failures)} failed:" if len(failures) > 1 else "Failed:")
        for name, reason in failures:
            console.error(f"  {name}: {reason}")
        sys.exit(RUN_ERROR)


def compose_jobs(
    config_name: str, overrides: Sequence[str], multirun: bool, config_folder: str | None = None
) -> Iterator[tuple[dict[str, Any], dict[str, str], list[str]]]:
    """Composes every job of a command: (plain configuration, group -> word, overrides without sweeps).

    Raises:
        UserError: what Hydra refuses, in one sentence.
    """
    extra = [f"hydra.searchpath=[file://{Path(config_folder).resolve()}]"] if config_folder else []
    with _one_sentence(), initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        for job in _expand(overrides) if multirun else [list(overrides)]:
            try:
                config = compose(config_name, overrides=[*extra, *job], return_hydra_config=True)
            except (HydraException, OmegaConfBaseException) as error:
                raise UserError(_told(error, config_name, job)) from error
            choices = _choices(config.hydra.runtime.choices)
            with_own_keys = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
            yield plain(with_own_keys), choices, job


def _preflight(config_name: str, check: Check) -> None:
    """Composes and checks every job of the command line, unless it only asks for help or for the configuration."""
    arguments = get_args_parser().parse_args()
    asks = arguments.help or arguments.hydra_help or arguments.info or arguments.shell_completion
    if asks or arguments.config_path:
        return
    jobs = compose_jobs(
        arguments.config_name or config_name, arguments.overrides, arguments.multirun, arguments.config_dir
    )
    for raw, choices, overrides in jobs:
        if not arguments.cfg:
            check(raw, choices, overrides)


def _expand(overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of a sweep, as Hydra's own sweeper makes them."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    if any(override.key_or_group == "hydra/sweeper" for override in parsed):
        # another sweeper chooses its values as it goes; each of its jobs is checked when it starts
        fixed = [o for o in parsed if not o.is_sweep_override()]
        return [[str(o.input_line) for o in fixed]]
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def _choices(choices: Any) -> dict[str, str]:
    """The words chosen on the command line or by default, Hydra's own groups left out."""
    return {str(k): str(v) for k, v in choices.items() if not str(k).startswith("hydra/") and v is not None}


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


@contextlib.contextmanager
def _one_sentence() -> Iterator[None]:
    """Turns Hydra's errors outside of composition (a malformed sweep) into `UserError`."""
    GlobalHydra.instance().clear()
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(_told(error, "", [])) from error
    finally:
        GlobalHydra.instance().clear()


def _told(error: Exception, config_name: str, overrides: Sequence[str]) -> str:
    """What Hydra or OmegaConf says in several lines, as one sentence with the key, the value and what to do."""
    text = str(error)
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, word = str(error.missing_cfg_file).rpartition("/")
        return (
            f"{group}={word}: there is no such choice{did_you_mean(word, error.options)} ({', '.join(error.options)})."
        )
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be read: {one_line(Exception(text.splitlines()[0]))}."
    no_group = re.match(r"Could not override '([^']+)'\.\s+No match in the defaults list", text)
    if no_group:
        word = no_group.group(1)
        return f"{word}=... names no default choice: write +{word}=... to add it."
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown.group(1)
        value = next((o.split("=", 1)[1] for o in overrides if o.split("=", 1)[0].strip("+~") == key), None)
        given = f" = {value}" if value is not None else ""
        return f"Unknown key {key}{given}{did_you_mean(key, _known_keys(config_name))}."
    return f"{one_line(Exception(text))}."


def _known_keys(config_name: str) -> list[str]:
    """All keys of the configuration without overrides, dotted."""

    def walk(value: object, prefix: str) -> Iterator[str]:
        if isinstance(value, dict):
            for name, item in value.items():
                yield f"{prefix}{name}"
                yield from walk(item, f"{prefix}{name}.")

    config = compose(config_name)
    return list(walk(OmegaConf.to_container(config, resolve=False), ""))


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Makes Ctrl-C and SIGTERM raise `Interrupted`, which nothing on the way takes for an error."""

    def stop(signum: int, _frame: object) -> None:
        raise Interrupted(signum)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def command_line() -> str:
    """The command that started this process, as one can type it again."""
    import shlex

    program = Path(sys.argv[0])
    if program.suffix == ".py" and program.parent.name == "apex_lab":
        words = ["python", "-m", f"apex_lab.{program.stem}"]
    else:
        words = [os.path.basename(sys.argv[0])]
    return shlex.join([*words, *sys.argv[1:]])

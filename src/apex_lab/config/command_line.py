"""From the words on the command line to checked jobs: what all entry points share.

Hydra composes, expands sweeps and launches. Before it starts, every job of the command is composed and checked here, so
that the third of four jobs' misspelt value is found before the first one starts, `++` included.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Sequence
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
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.base.validation import did_you_mean, one_line, sentence
from apex_lab.config.schema import conf_dir, plain

Check = Callable[[dict[str, Any], dict[str, str], Sequence[str]], Any]
"""(plain configuration, group -> word, overrides) -> a checked job; raises UserError."""

CHOICES = ("model", "ablation", "data", "scale", "experiment")
"""Groups that name a run; a run has one choice of each."""

CONFIG_ERROR = 2
RUN_ERROR = 1


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
    jobs = 0

    def task(config: DictConfig) -> None:
        nonlocal jobs
        jobs += 1
        console.setup()  # the launcher may have put this job into a process of its own
        overrides = list(HydraConfig.get().overrides.task)
        name = " ".join(overrides)
        try:
            job = check(plain(config), _choices(HydraConfig.get().runtime), overrides)
            name = title(job)
            work(job)
        except UserError as error:
            console.error(str(error))
            failures.append((name, one_line(error)))
            _tell_launcher(name, one_line(error))
        except Exception as error:  # noqa: BLE001 - reported below; the other jobs of a sweep must still run
            traceback.print_exc()
            failures.append((name, f"{type(error).__name__}: {one_line(error)}"))
            _tell_launcher(name, f"{type(error).__name__}: {one_line(error)}")

    sys.argv[1:] = _full_names(_options_last(sys.argv[1:]))
    if config_name == "evaluate":
        # the checkpoint brings the data's settings, so no file here has them; the check knows which exist
        sys.argv[1:] = [f"++{word}" if word.startswith("data.") else word for word in sys.argv[1:]]
    try:
        with interruptible():
            _preflight(config_name, check)
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(task)()
    except UserError as error:
        console.error(str(error))
        sys.exit(CONFIG_ERROR)
    except Interrupted as stop:
        console.error(f"Stopped by {stop}; the same command resumes from here.")
        sys.exit(128 + stop.signum)
    if failures:
        if jobs > 1:
            console.error(f"{len(failures)} of {jobs} failed:")
            for name, reason in failures:
                console.error(f"  {name}: {reason}")
        sys.exit(RUN_ERROR)


class JobFailed(RuntimeError):
    """A job of a sweep failed in a process of its own."""


def _tell_launcher(name: str, reason: str) -> None:
    """Fails the job towards launchers that run it in another process, which does not share our list of failures.

    Hydra hands the failure back in the job's return, so the exit code is right under every launcher.

    Raises:
        JobFailed: the launcher is not Hydra's basic one.
    """
    config = HydraConfig.get()
    if config.mode == RunMode.MULTIRUN and not config.launcher._target_.endswith(".BasicLauncher"):
        raise JobFailed(f"{name}: {reason}")


def _preflight(config_name: str, check: Check) -> None:
    """Composes and checks every job of the command line, unless it only asks for help or for the configuration.

    Raises:
        UserError: what Hydra or the check refuses, in one sentence.
    """
    arguments = get_args_parser().parse_args()
    if arguments.multirun and (arguments.cfg or arguments.info):
        raise UserError("-m cannot stand beside --cfg or --info: leave it out to see one job's configuration.")
    if arguments.help or arguments.hydra_help or arguments.info or arguments.shell_completion or arguments.cfg:
        return
    extra = []
    if arguments.config_dir is not None:
        if not Path(arguments.config_dir).is_dir():
            raise UserError(f"--config-dir {arguments.config_dir} is not a folder.")
        extra = [f"hydra.searchpath=[file://{Path(arguments.config_dir).resolve()}]"]
    name = arguments.config_name or config_name
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=arguments.config_path or str(conf_dir())):
            _check_hydra_keys(name, extra, arguments.overrides)
            _check_groups(config_name, arguments.overrides)
            sweep = arguments.multirun or "hydra.mode=MULTIRUN" in arguments.overrides
            for overrides in _expand(arguments.overrides) if sweep else [arguments.overrides]:
                _check_composed(name, extra, overrides, check)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(_told(error, arguments.overrides)) from error
    finally:
        GlobalHydra.instance().clear()


def _check_composed(name: str, extra: Sequence[str], overrides: Sequence[str], check: Check) -> None:
    """Composes one job and checks it."""

    def attempt(words: Sequence[str]) -> None:
        config = compose(name, overrides=[*extra, *words], return_hydra_config=True)
        choices = _choices(config.hydra.runtime)
        own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        check(plain(own), choices, overrides)

    try:
        attempt(overrides)
    except HydraException as error:
        absent = re.match(r"Could not override '([^']+)'\.\s+To append to your config", str(error))
        if absent is None:
            raise
        # Hydra only knows that no file sets the key; the check knows whether it exists and what is close to it
        key = absent.group(1)
        attempt([f"++{word}" if word.startswith(f"{key}=") else word for word in overrides])
        word = next(word for word in overrides if word.startswith(f"{key}="))
        raise UserError(f"{key} is set by no file that was chosen: write ++{word} to add it.") from error


_FREE = ("hydra.job.env_set.", "hydra.sweeper.params.")
"""Keys of Hydra's own configuration whose names its user chooses."""


def _check_hydra_keys(name: str, extra: Sequence[str], overrides: Sequence[str]) -> None:
    """Refuses keys that Hydra's own configuration does not have, which `+` and `++` would add without a word."""
    added = [word for word in overrides if re.match(r"\+\+?hydra\.", word) and not word.lstrip("+").startswith(_FREE)]
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


def _expand(overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of a sweep, as Hydra's own sweeper makes them."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    if any(override.key_or_group == "hydra/sweeper" for override in parsed):
        # another sweeper chooses its values as it goes; each of its jobs is checked when it starts
        fixed = [o for o in parsed if not o.is_sweep_override()]
        return [[str(o.input_line) for o in fixed]]
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def _choices(runtime: Any) -> dict[str, str]:
    """The words chosen on the command line or by default; Hydra's own groups, and a recipe without a file, left out."""
    choices = runtime.choices.items()
    found = {str(k): str(v) for k, v in choices if not str(k).startswith("hydra/") and v is not None}
    folders = [Path(source.path) for source in runtime.config_sources if source.schema == "file"]
    if not any((folder / "recipe" / f"{found.get('recipe')}.yaml").is_file() for folder in folders):
        found.pop("recipe", None)
    return found


SHORT = {name: f"model/apex/{name}" for name in ("likelihood", "masks", "glimpses")}
"""Short word -> group: APEX's swappable parts may be chosen by the last part of their names."""


def _full_names(arguments: Sequence[str]) -> list[str]:
    """The same words with the full names of groups."""

    def full(word: str) -> str:
        key, equals, value = word.partition("=")
        return f"{SHORT[key]}={value}" if equals and key in SHORT else word

    return [full(word) for word in arguments]


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


def _told(error: Exception, overrides: Sequence[str]) -> str:
    """A message of Hydra or OmegaConf of several lines, as one sentence with the key, the value and what to do."""
    text = str(error)
    given = {word.split("=", 1)[0].lstrip("+~"): word.lstrip("+~") for word in overrides}
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, word = str(error.missing_cfg_file).rpartition("/")
        guess = did_you_mean(word, error.options)
        return sentence(f"{group}={word}: there is no such choice in {', '.join(error.options)}{guess}")
    several = re.match(r"Ambiguous value for argument '([^=']+)=([^']*)'", text)
    if several:
        key, values = several.groups()
        if key.lstrip("+") in CHOICES:
            return f"{key}={values} holds several values: add -m to run them all."
        return f"{key}={values} holds several values: add -m to run them all, or write {key}=[{values}] for a list."
    if isinstance(error, OverrideParseException):
        return sentence(f"'{error.override}' cannot be read as key=value: {text.splitlines()[0]}")
    unlisted = re.match(r"(?:In '([^']+)': )?Could not override '([^']+)'\.\s+No match in the defaults list", text)
    if unlisted:
        inside, group = unlisted.groups()
        if inside or group in SHORT.values():
            chosen = inside.replace("/", "=") if inside else given.get(group, group)
            part = group.rpartition("/")[2]
            return f"{chosen} swaps APEX's {part}, and no APEX is chosen here: add model=apex."
        return f"{given.get(group, group)} has no default to replace: write +{given.get(group, group)}."
    there = re.match(r"Could not append to config\. An item is already at '([^']+)'", text)
    if there:
        return f"{there.group(1)} is there already: write {given.get(there.group(1), there.group(1))} without the +."
    return sentence(text)


def command_line() -> str:
    """The command that started this process, as one can type it again."""
    program = Path(sys.argv[0])
    if program.suffix == ".py" and program.parent.name == "apex_lab":
        words = ["python", "-m", f"apex_lab.{program.stem}"]
    else:
        words = [os.path.basename(sys.argv[0])]
    return shlex.join([*words, *sys.argv[1:]])

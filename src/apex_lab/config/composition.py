"""Composes configurations by Hydra, and turns what Hydra refuses into one sentence. Imports no PyTorch.

Seeds of one configuration differ in one number, so a list of jobs is composed once per configuration.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apex_lab.base.errors import UserError
from apex_lab.base.validation import did_you_mean, sentence, shown, to_open
from apex_lab.config import initial, resolvers, trust
from apex_lab.config.upgrades import fingerprint

resolvers.register()

CHOICES = ("model", "ablation", "data", "scale", "experiment", "tuned")
"""Groups that name a run; a run has one choice of each."""

EXTRAS = {"joblib": "launchers", "submitit_local": "launchers", "submitit_slurm": "launchers", "ray": "ray"}
"""Launcher -> the extra of apex_lab that brings it."""

SHORT = {name: f"model/apex/{name}" for name in ("likelihood", "masks", "glimpses")}
"""Short word -> group: APEX's swappable parts may be chosen by the last part of their names."""


@dataclass(frozen=True)
class Composed:
    """One configuration as Hydra composes it.

    Attributes:
        raw: plain containers, all interpolations resolved, without Hydra's own part; seeds of one configuration share
            all but the seed, so it is not to be changed.
        choices: group -> the word chosen for it.
        words: the overrides that made it.
        identity: its fingerprint, common to its seeds.
    """

    raw: dict[str, Any]
    choices: dict[str, str]
    words: tuple[str, ...]
    identity: str


def conf_dir() -> Path:
    """The folder of configuration files: inside the installed package, else the repository's.

    Raises:
        UserError: neither is there (a damaged installation).
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "conf", package.parent.parent / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise UserError(f"No configuration files at {package / 'conf'}: install apex_lab again.")


def plain(config: DictConfig) -> dict[str, Any]:
    """A composed configuration as plain containers, all interpolations resolved; `???` stays where a value is missing.

    Weights that training starts from stand there with their digest (`apex_lab.config.initial`).

    Raises:
        UserError: an interpolation leads nowhere, or there are no such weights.
    """
    try:
        container = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    except OmegaConfBaseException as error:
        key = f"{error.full_key}: " if error.full_key else ""
        raise UserError(sentence(key + str(error.msg).splitlines()[0])) from error
    assert isinstance(container, dict)
    raw: dict[str, Any] = {str(key): value for key, value in container.items()}
    if raw.get(initial.KEY) is not None:
        paths = raw.get("paths")
        raw[initial.KEY] = initial.identified(
            raw[initial.KEY], paths.get("outputs") if isinstance(paths, dict) else None
        )
    return raw


def chosen(runtime: Any) -> dict[str, str]:
    """The words chosen on the command line or by default; Hydra's own groups, and optional files not there, left out.

    Args:
        runtime: the `hydra.runtime` part of a composed configuration.
    """
    choices = runtime.choices.items()
    found = {str(k): str(v) for k, v in choices if not str(k).startswith("hydra/") and v is not None}
    for key, word in found.items():
        group, elsewhere, package = key.partition("@")
        check_choice(key, word)
        if elsewhere:  # no check of a choice would see it
            raise UserError(f"{key}={found[key]}: a choice of {group} has its own place: leave out @{package}.")
    folders = [Path(source.path) for source in runtime.config_sources if source.schema == "file"]
    return {
        group: word for group, word in found.items() if any((at / group / f"{word}.yaml").is_file() for at in folders)
    }


def check_choice(group: str, word: str) -> None:
    """Refuses what is no name of a file in a group, such as ../model/apex: it would name the run's folder too.

    Raises:
        UserError: the word is none.
    """
    if not _CHOSEN.fullmatch(word):
        raise UserError(f"{group}={word} is no name of a choice: write {group}={_stem(word)}.")


_CHOSEN = re.compile(r"\w[\w+-]*(/\w[\w+-]*)*")
"""Names of files in a group, without their ending, in folders of it perhaps."""


def _stem(word: str) -> str:
    """The name that a path was meant to be, as far as that shows."""
    return word.rpartition("/")[2].removesuffix(".yaml").removesuffix(".yml") or "..."


def full_names(words: Sequence[str]) -> list[str]:
    """The same words with the full names of groups."""

    def full(word: str) -> str:
        key, equals, value = word.partition("=")
        return f"{SHORT[key]}={value}" if equals and key in SHORT else word

    return [full(word) for word in words]


@contextmanager
def composing(overrides: Sequence[str], folder: str | None = None) -> Iterator[None]:
    """Inside, Hydra composes from the project's files; what it refuses becomes a sentence.

    Args:
        overrides: the words of the command line, which the sentences cite.
        folder: of configuration files, instead of the project's.

    Raises:
        UserError: Hydra or OmegaConf refused something.
    """
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=folder or str(conf_dir())), needing_folders():
            yield
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(told(error, overrides)) from error
    except ValueError as error:
        if not str(error).startswith("Config group override must be"):
            raise
        raise UserError(_no_choice(overrides)) from error
    finally:
        GlobalHydra.instance().clear()


@contextmanager
def needing_folders() -> Iterator[None]:
    """Inside, Hydra passes over no folder of its search path that is not there.

    Raises:
        UserError: there is one.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=_NOT_AVAILABLE)
        try:
            yield
        except UserWarning as error:
            found = re.match(_NOT_AVAILABLE, str(error))
            if found is None:
                raise
            raise UserError(f"hydra.searchpath: {found[1]} is not available: give folders that are there.") from error


_NOT_AVAILABLE = r"provider=.*, path=(.*) is not available"
"""What Hydra warns of, in a line of its own code, before it goes on without a folder."""


def composed(
    name: str,
    jobs: Sequence[Sequence[str]],
    extra: Sequence[str] = (),
) -> Iterator[Composed]:
    """Composes jobs in their order; to be called inside `composing`.

    Args:
        name: the file in conf/ without its ending.
        jobs: the words of each.
        extra: words for Hydra that belong to all, such as a search path.
    """
    templates: dict[tuple[str, ...], _Template] = {}
    for words in jobs:
        rest = tuple(word for word in words if not word.startswith("seed="))
        if rest not in templates:
            templates[rest] = _Template(name, [*extra, *words])
        template = templates[rest]
        for word in words:
            if word.startswith("seed="):
                template.reseed(word)
        raw, identity = template.resolved()
        yield Composed(raw, template.choices, tuple(words), identity)


class _Template:
    """A composed configuration whose seed changes."""

    def __init__(self, name: str, words: Sequence[str]) -> None:
        config = compose(name, overrides=list(words), return_hydra_config=True)
        self.choices = chosen(config.hydra.runtime)
        _check_tuned(self.choices, config.hydra.runtime)
        self._config = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        OmegaConf.set_struct(self._config, False)
        # nothing but the seed itself depends on it, so the rest is resolved once
        self._apart = not re.search(r"\$\{[^}]*seed", str(OmegaConf.to_container(self._config, resolve=False)))
        self._resolved: tuple[dict[str, Any], str] | None = None
        self._seed: dict[str, Any] = {}

    def reseed(self, word: str) -> None:
        """Takes another seed, as the command line gives it."""
        value = word.removeprefix("seed=")
        seed = (
            int(value) if re.fullmatch(r"0|[1-9]\d*", value) else OverridesParser.create().parse_override(word).value()
        )
        self._seed = {"seed": seed}

    def resolved(self) -> tuple[dict[str, Any], str]:
        """The configuration with its seed, and its fingerprint."""
        if self._apart and self._resolved is not None:
            raw, identity = self._resolved
            return {**raw, **self._seed}, identity
        for key, value in self._seed.items():
            OmegaConf.update(self._config, key, value)
        raw = plain(self._config)
        self._resolved = raw, fingerprint(raw)
        return self._resolved


def outputs_folder(words: Sequence[str]) -> Path:
    """The folder of runs.

    Args:
        words: those of a command line that begin with `paths.`.

    Raises:
        UserError: they set no folder.
    """
    with composing(words):
        paths = plain(compose("train", overrides=list(words)))["paths"]
        return folder_of_runs(paths.get("outputs") if isinstance(paths, Mapping) else paths)


def folder_of_runs(value: object) -> Path:
    """The folder that `paths.outputs` names.

    Raises:
        UserError: it names none, as an unset variable does.
    """
    if not isinstance(value, str):
        raise UserError(f"paths.outputs = {shown(value)} is wrong: give a folder.")
    return to_open("paths.outputs", value)


def _check_tuned(choices: Mapping[str, str], runtime: Any) -> None:
    """Refuses a file of `+tuned=<name>` that does more than set values, since such files are passed on.

    Raises:
        UserError: what it may not hold, another model that it is of, or a second file of its name.
    """
    if "tuned" not in choices:
        return
    name, found = choices["tuned"], ""
    folders = [Path(source.path) for source in runtime.config_sources if source.schema == "file"]
    for file in (folder / "tuned" / f"{name}.yaml" for folder in folders):
        if file.is_file():
            text = file.read_text(encoding="utf-8")
            if found not in ("", text):
                raise UserError(f"+tuned={name} takes another file than {file}, which has its name: rename that one.")
            found = text
            of = re.search(rf"^{re.escape(OF_LINE)}model=(\S+)", text, re.MULTILINE)
            if of is not None and of[1] != choices.get("model", of[1]):
                raise UserError(
                    f"+tuned={name} has values for model={of[1]} ({file}), and this run has model={choices['model']}: "
                    f"leave out +tuned={name}, or choose model={of[1]}."
                )
            for package in _PACKAGE.findall(text):
                if package != "_global_":
                    raise UserError(f"{file} may not be put at {package}: write # @package _global_ and whole keys.")
            content = yaml.safe_load(text) or {}
            trust.only_values(content, str(file))
            _check_shipped(content, folders, str(file))


OF_LINE = "# Of: python -m apex_lab.train "
"""Start of the line of a tuned file that says what was tuned."""

_PACKAGE = re.compile(r"^\s*#\s*@package\s+(\S+)", re.MULTILINE)


def _check_shipped(content: Mapping[str, Any], folders: Sequence[Path], source: str) -> None:
    """Refuses choices of a tuned file that lead to files which came along with it."""
    for entry in content.get("defaults", []):
        for key, word in entry.items() if isinstance(entry, Mapping) else ():
            name = f"{key.rpartition(' ')[2].lstrip('/')}/{word}.yaml"
            if any((folder / name).is_file() for folder in folders if folder.resolve() != conf_dir()):
                raise UserError(f"{source} may only choose files of apex_lab, and {name} lies elsewhere.")


def _no_choice(overrides: Sequence[str]) -> str:
    """The sentence for a group that gets a number or null in place of a word."""
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        group = override.key_or_group
        values = list(override.sweep_iterator()) if override.is_discrete_sweep() else [override.value()]
        folder = conf_dir() / group
        if folder.is_dir() and not all(isinstance(value, str | list) for value in values):
            files = list(folder.glob("*.yaml")) or folder.rglob("*.yaml")
            known = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in files)
            return sentence(f"{override.input_line} names no choice of {group}: write one of {', '.join(known)}")
    return "A choice is a word, and one of these is a number or null: " + sentence(" ".join(overrides))


def not_there(error: Exception) -> str | None:
    """The key that no chosen file sets, where that is what Hydra refuses."""
    found = re.match(r"Could not override '([^']+)'\.\s+To append to your config", str(error))
    return found.group(1) if found else None


def told(error: Exception, overrides: Sequence[str]) -> str:
    """A message of Hydra or OmegaConf of several lines, as one sentence with the key, the value and what to do."""
    text = str(error)
    given = {word.split("=", 1)[0].lstrip("+~"): word.lstrip("+~") for word in overrides}
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, word = str(error.missing_cfg_file).rpartition("/")
        if group == "tuned" and not error.options:
            return f"tuned={word}: no study has written its values here; docs/tuning.md says how one does."
        if group == "hydra/launcher" and word in EXTRAS:
            return f"{group}={word} needs a package that is not installed: pip install 'apex-lab[{EXTRAS[word]}]'."
        part = group.rpartition("/")[2]
        if part.endswith("_for") and error.options:
            other = "p2d" if "p2d" in error.options else error.options[0]
            return (
                f"{group} has no file for data={word}: take another data set's, such as {group}={other}, of "
                f"{', '.join(error.options)}."
            )
        guess = did_you_mean(word, error.options)
        return sentence(f"{group}={word}: there is no such choice in {', '.join(error.options)}{guess}")
    several = re.match(r"Ambiguous value for argument '([^=']+)=([^']*)'", text)
    if several:
        key, values = several.groups()
        if key.lstrip("+") in CHOICES:
            return f"{key}={values} holds several values: add -m to run them all."
        return f"{key}={values} holds several values: add -m to run them all, or write {key}=[{values}] for a list."
    if isinstance(error, OverrideParseException):
        key, equals, value = str(error.override).partition("=")
        advice = ""
        if equals and "'" not in value and '"' not in value and "\\" not in value and not value.startswith(("[", "{")):
            advice = f""" (in a value with special characters, quote it for Hydra too: '{key}="{value}"')"""
        return sentence(f"'{error.override}' cannot be read as key=value: {text.splitlines()[0]}{advice}")
    unlisted = re.match(r"(?:In '([^']+)': )?Could not override '([^']+)'\.\s+No match in the defaults list", text)
    if unlisted:
        inside, group = unlisted.groups()
        if inside or group in SHORT.values():
            choice = inside.replace("/", "=") if inside else given.get(group, group)
            part = group.rpartition("/")[2]
            return f"{choice} swaps APEX's {part}, and no APEX is chosen here: add model=apex."
        return f"{given.get(group, group)} has no default to replace: write +{given.get(group, group)}."
    there = re.match(r"Could not append to config\. An item is already at '([^']+)'", text)
    if there:
        return f"{there.group(1)} is there already: write {given.get(there.group(1), there.group(1))} without the +."
    return sentence(text)

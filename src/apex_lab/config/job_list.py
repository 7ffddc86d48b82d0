"""From the words of one command to the words of its jobs.

`seed=0,1 model.grid=4,8` is a product. `+sweep=<name>` is a list: conf/sweep/<name>.yaml names entries, each a product
of its own, and what they make together is the sweep:

    jobs:
      - {model: [apex, space], seed: [0, 1, 2, 3]}          # eight jobs
      - {model: apex, +ablation: no_entropy, seed: [0, 1]}  # two more
    include: [tracking]                                     # and those of another sweep

Keys stand as on the command line. A key that the command gives too has the command's values in every entry.

    exceptions: # jobs of this model on this data at this scale have these values, unless the command gives others
      - {where: {model: space, data: p2d, scale: cpu}, set: {+tuned: space}}
"""

from __future__ import annotations

import copy
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from hydra import compose
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf
from pydantic import BaseModel, ConfigDict

from apex_lab.base.errors import UserError
from apex_lab.base.validation import validate
from apex_lab.config import trust
from apex_lab.config.composition import check_choice

Words = tuple[str, ...]

MOST = 100_000
"""Jobs of a command; each is composed and checked before the first one starts."""

Value = str | int | float | bool | None

Values = dict[str, Value | tuple[Value, ...]]
"""Key -> value or values."""


class Where(BaseModel):
    """Choices that jobs are told by; None: any."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    model: str | tuple[str, ...] | None = None
    data: str | tuple[str, ...] | None = None
    scale: str | tuple[str, ...] | None = None

    def fits(self, chosen: Mapping[str, str]) -> bool:
        """Whether a job's choices are among these."""
        asked = {group: getattr(self, group) for group in Where.model_fields}
        return all(
            chosen[group] in ((words,) if isinstance(words, str) else words)
            for group, words in asked.items()
            if words is not None
        )


class ExceptionPart(BaseModel):
    """Values of some of a file's jobs, in place of those of their entries or beside them."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    where: Where
    set: Values


class SweepFile(BaseModel):
    """What a file in conf/sweep/ may hold.

    Attributes:
        jobs: entries.
        exceptions: for its own entries, later ones over earlier ones.
        include: other sweeps.
        tables: numbers of the paper's tables that it makes; None: all that are made from scores.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    jobs: tuple[Values, ...] = ()
    exceptions: tuple[ExceptionPart, ...] = ()
    include: tuple[str, ...] = ()
    tables: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Entry:
    """An entry of a sweep file: key -> the words of its values; exceptions likewise."""

    words: dict[str, list[str]]
    exceptions: tuple[tuple[Where, dict[str, list[str]]], ...] = ()


def expand(overrides: Sequence[str], extra: Sequence[str] = ()) -> list[Words]:
    """The jobs of a command line with `-m`, each as the words that compose it, in the order in which they run.

    To be called where Hydra is initialised. Words for Hydra itself are left out.

    Args:
        overrides: the words of the command.
        extra: words for Hydra with which sweep files are found, such as a search path.

    Raises:
        UserError: a sweep file is not there or damaged; an interval, which has no list of values.
        HydraException: a word cannot be read.
    """
    given: dict[str, list[str]] = {}
    sweeps: list[str] = []
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if key.lstrip("+~").startswith(("hydra.", "hydra/")):
            continue
        if override.key_or_group == "sweep":
            sweeps += _values(override)
        elif isinstance(override.value(), Glob):
            override.config_loader = _loader(extra)
            given[key] = [f"{key}={value}" for value in _values(override)]
            if not given[key]:
                raise UserError(f"{override.input_line} fits no choice of {override.key_or_group}.")
        elif override.is_delete() and override.value() is None:
            given[key] = [key]
        else:
            given[key] = [f"{key}={value}" for value in _values(override)]
    if not sweeps:
        return _product({}, given)
    jobs: list[Words] = []
    for name in sweeps:
        for entry in read_sweep(name, extra):
            for words, own in _with_exceptions(entry, given, extra):
                jobs += _product(words, own)
    return list({frozenset(job): job for job in jobs}.values())


def _loader(extra: Sequence[str]) -> ConfigLoader:
    """What finds the choices of a group, in the folder given as `--config-dir` too."""
    loader = GlobalHydra.instance().config_loader()
    path = copy.deepcopy(loader.get_search_path())
    for folder in re.findall(r"file://[^\],]+", " ".join(extra)):
        path.append("command-line", folder)
    return ConfigLoaderImpl(path)


def _product(entry: Mapping[str, Sequence[str]], given: Mapping[str, Sequence[str]]) -> list[Words]:
    """The jobs of one entry under a command's own words."""
    replaced = {key.lstrip("+") for key in given}
    kept = {key: words for key, words in entry.items() if key.lstrip("+") not in replaced}
    lists = [*kept.values(), *given.values()]
    if (number := math.prod(len(words) for words in lists)) > MOST:
        raise UserError(f"These words make {number:,} jobs, and one command runs {MOST:,} at most: name fewer values.")
    return [tuple(job) for job in itertools.product(*lists)]


def _with_exceptions(
    entry: Entry, given: Mapping[str, Sequence[str]], extra: Sequence[str]
) -> Iterator[tuple[Mapping[str, Sequence[str]], Mapping[str, Sequence[str]]]]:
    """An entry and a command's words, split by what exceptions look at: each part with the values that it has."""
    if not entry.exceptions:
        yield entry.words, given
        return
    usual = compose("train", overrides=list(extra), return_hydra_config=True).hydra.runtime.choices
    lists = [given.get(g) or entry.words.get(g) or [f"{g}={usual[g]}"] for g in Where.model_fields]
    for words in itertools.product(*lists):
        chosen = dict(word.split("=", 1) for word in words)
        one = {group: [f"{group}={word}"] for group, word in chosen.items()}
        found = entry.words | {group: one[group] for group in entry.words if group in one}
        for where, values in entry.exceptions:
            found |= values if where.fits(chosen) else {}
        yield found, {key: one.get(key, values) for key, values in given.items()}


def _values(override: Override) -> list[str]:
    """All values of one word as they stand on a command line.

    Raises:
        UserError: they cannot be listed, or are too many.
    """
    if not override.is_sweep_override():
        return [override.get_value_element_as_str()]
    if not override.is_discrete_sweep():
        raise UserError(
            f"{override.input_line} is an interval, which has no list of values: name them, or search by apex_lab.tune."
        )
    if isinstance(override.value(), Glob) and override.config_loader is None:
        raise UserError(f"{override.input_line} is a pattern, which fits files of a group alone: name the values.")
    values = list(itertools.islice(override.sweep_string_iterator(), MOST + 1))
    if len(values) > MOST:
        raise UserError(f"{override.input_line} holds more than {MOST:,} values: name fewer.")
    return values


def read_sweep(name: str, extra: Sequence[str] = (), seen: Words = ()) -> list[Entry]:
    """The entries of a sweep file and of those that it includes.

    Raises:
        UserError: it is not there, includes itself, or holds what it may not.
    """
    if name in seen:
        raise UserError(f"conf/sweep/{seen[0]}.yaml includes itself ({' > '.join([*seen, name])}).")
    file = _read(name, extra)
    if not file.jobs and not file.include:
        raise UserError(f"{_place(name)} lists no jobs.")
    exceptions = tuple((each.where, _worded(each.set)) for each in file.exceptions)
    entries = [Entry(_worded(entry), exceptions) for entry in file.jobs]
    worded = [*(entry.words for entry in entries), *(values for _, values in exceptions)]
    trust.only_words((word for entry in worded for words in entry.values() for word in words), _place(name))
    for other in file.include:
        entries += read_sweep(other, extra, (*seen, name))
    return entries


def sweeps(overrides: Sequence[str]) -> list[str]:
    """The names that a command gives as `+sweep=`."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return [name for override in parsed if override.key_or_group == "sweep" for name in _values(override)]


def tables_of(names: Sequence[str], extra: Sequence[str] = ()) -> list[int] | None:
    """Numbers of the tables that sweeps make; None where one of them makes all that its jobs have scores for."""
    files = [_read(name, extra) for name in names]
    numbers = {number for file in files for number in file.tables or ()}
    return None if any(file.tables is None for file in files) else sorted(numbers)


def _read(name: str, extra: Sequence[str]) -> SweepFile:
    check_choice("sweep", name)
    try:
        sweep = compose(f"sweep/{name}", overrides=list(extra)).sweep
    except MissingConfigException:
        sweep = compose("train", overrides=[*extra, f"+sweep={name}"]).sweep  # tells which there are
    node = OmegaConf.to_container(sweep, resolve=False)
    content = {str(key): value for key, value in node.items()} if isinstance(node, dict) else {"": node}
    file = validate(SweepFile, content, _place(name))
    assert isinstance(file, SweepFile)
    return file


def _place(name: str) -> str:
    return f"conf/sweep/{name}.yaml"


def _worded(values: Values) -> dict[str, list[str]]:
    """Key -> the words of its values."""
    lists = {key: value if isinstance(value, tuple) else (value,) for key, value in values.items()}
    return {key: [f"{key}={_word(one)}" for one in several] for key, several in lists.items()}


def _word(value: Value) -> str:
    """A value of a YAML file as it stands on a command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return str(value)

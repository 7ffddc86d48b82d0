"""What a file of a stranger may build: decided by name before anything is imported, then by class before it is built.

A checkpoint carries the configuration that made it, whose nodes name classes. Weights are read without running code,
but building `{_target_: os.system, command: ...}` would run it. So of files, the project's own components and a short
list of PyTorch's optimisers are built, and nothing else unless it is asked for by `trust=true`.
"""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from apex_lab.base.errors import UserError
from apex_lab.base.validation import shown

OPTIMISERS = frozenset(
    f"torch.optim.{name}" for name in ("Adam", "AdamW", "Adagrad", "NAdam", "RAdam", "RMSprop", "SGD")
)
OWN = re.compile(r"apex_lab\.(models|data|training)(\.[a-z][a-z0-9_]*)*\.[A-Z]\w*")
"""Full names of the project's components: a class in one of three packages."""


IN_CHECKPOINTS = "write trust=true if you trust whoever made this file"
IN_VALUES = "name it on the command line, or in a file of a group that chooses components"


def check(config: Any, where: str, known: Iterable[str] = (), advice: str = IN_CHECKPOINTS) -> None:
    """Refuses a configuration that names anything but components of the project.

    Args:
        config: plain containers.
        where: the file, for the message.
        known: further names that are allowed, because the user's own configuration has them.
        advice: what to do about another name.

    Raises:
        UserError: the first name that is refused.
    """
    allowed = frozenset(known)
    for key, name in targets(config):
        if not _is_own(name) and not (isinstance(name, str) and name in allowed):
            raise UserError(
                f"{where} wants to build {shown(name)} ({key}), which is no component of apex_lab: {advice}."
            )


def targets(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every `_target_` in a configuration with its key."""
    if isinstance(config, Mapping):
        for name, value in config.items():
            key = f"{prefix}.{name}" if prefix else str(name)
            if str(name).rpartition(".")[2] == "_target_":  # a key of a word or of a file may be dotted
                yield key, value
            else:
                yield from targets(value, key)
    elif isinstance(config, list | tuple):
        for i, value in enumerate(config):
            yield from targets(value, f"{prefix}[{i}]")


def _is_own(name: object) -> bool:
    if not isinstance(name, str):
        return False
    if name in OPTIMISERS:
        return True
    if OWN.fullmatch(name) is None:
        return False
    try:
        found = pkgutil.resolve_name(name)  # imports modules of this package alone
    except (ImportError, AttributeError, ValueError):
        return False
    # what a module of ours has imported from elsewhere is not ours
    return isinstance(found, type) and found.__module__.startswith("apex_lab.")


_CHOICE = re.compile(r"(optional )?(override )?/(?!hydra\b)\w+(/\w+)*")
_WORD = re.compile(r"\w[\w-]*(/\w[\w-]*)*")


def only_values(node: Any, source: str, known: Iterable[str] = ()) -> None:
    """Refuses a configuration file, such as a tuned one, that does more than choose shipped files and set values.

    It may set values of keys, name the project's components by `_target_`, and override choices in a defaults list. It
    may not hold interpolations: `${oc.env:...}` would read the environment into the stored configuration of the run.

    Args:
        node: its content, as `yaml.safe_load` gives it.
        source: the file, for the message.
        known: names of further classes that are allowed.

    Raises:
        UserError: the first thing that it may not hold.
    """
    if not isinstance(node, Mapping):
        raise UserError(f"{source} must set values of keys, and holds {shown(node)}.")
    entries = node.get("defaults", [])
    for entry in entries if isinstance(entries, list) else [entries]:
        if entry == "_self_":
            continue
        fine = isinstance(entry, Mapping) and all(
            _CHOICE.fullmatch(str(group)) and isinstance(word, str) and _WORD.fullmatch(word)
            for group, word in entry.items()
        )
        if not fine:
            raise UserError(
                f"{source} may not have {shown(entry)} among its defaults, which choose alone: /model: apex."
            )
    _refuse_more_than_values({key: value for key, value in node.items() if key != "defaults"}, source, known)


def only_words(words: Iterable[str], source: str, known: Iterable[str] = ()) -> None:
    """Refuses words of a command line that come from a file, such as a sweep, and do more than `only_values` allows.

    Args:
        words: each `key=value`, as Hydra reads them.
        source: the file, for the message.
        known: names of further classes that are allowed.

    Raises:
        UserError: the first that is refused.
        OverrideParseException: Hydra cannot read one.
    """
    known, words = frozenset(known), list(words)
    for word in words:
        _refuse_interpolation(word, source)
    for override in OverridesParser.create().parse_overrides(words):
        line = str(override.input_line)
        if "@" in override.get_key_element():
            raise UserError(f"{source} may not hold {shown(line)}: a choice has its own place, so leave out the @.")
        key = re.sub(r"/.*", "", override.get_key_element().lstrip("+~"))
        if override.is_sweep_override() and "_target_" in line:
            raise UserError(f"{source} may not hold {shown(line)}: write the values as a list.")
        value = None if override.is_delete() or override.is_sweep_override() else override.value()
        _refuse_more_than_values({key: value}, source, known)


def _refuse_more_than_values(node: Mapping[str, Any], source: str, known: Iterable[str]) -> None:
    check(node, source, known, IN_VALUES)
    for key, value in _leaves(node):
        if key.partition(".")[0] == "hydra":
            raise UserError(f"{source} may not set {key}, which is Hydra's own: give it on the command line.")
        for text in (key, value):
            _refuse_interpolation(text, source)


def _refuse_interpolation(text: Any, source: str) -> None:
    if isinstance(text, str) and "${" in text:
        raise UserError(f"{source} may not hold {shown(text)}: write the value itself.")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no container, and every empty container, with its key."""
    if isinstance(node, Mapping) and node:
        for name, value in node.items():
            yield from _leaves(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(node, list | tuple) and node:
        for i, value in enumerate(node):
            yield from _leaves(value, f"{prefix}[{i}]")
    else:
        yield prefix, node

"""An ablation names a row of a table, so what its file sets must be in force in the run that bears its name.

Words after it on the command line come later in the composition and can undo it: the run would fill the row with
something else. Experiments are starting points, and their values may be changed; but those of an original publication
change a recipe of the paper's scale, and nothing else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from apex_lab.base.errors import UserError
from apex_lab.base.validation import shown

_PACKAGE = re.compile(r"^\s*#\s*@package\s+(\S+)\s*$", re.MULTILINE)
_MISSING = object()


def check(raw: Mapping[str, Any], choices: Mapping[str, str], conf: Path) -> None:
    """Compares a composed configuration with what its ablation sets.

    That is: the values in the ablation's file, the choices in its defaults list, and the classes that the files of
    these choices name. Their other values may be tuned. What holds an interpolation is not compared, and nothing is
    where `conf` has no file of that name (an ablation of the user's own).

    Args:
        raw: plain containers, all interpolations resolved.
        choices: group -> word.
        conf: folder of configuration files.

    Raises:
        UserError: a value or a choice is another one.
    """
    name = choices.get("ablation")
    file = conf / "ablation" / f"{name}.yaml"
    if name is None or not file.is_file():
        return
    for group, word in _swaps(_content(file)):
        chosen = choices.get(group, word)
        if chosen != word:
            short = group.rpartition("/")[2]
            _refuse(name, f"{short}={word}", f"{short}={chosen}")
        part = conf / group / f"{word}.yaml"
        for key, value in _values(part) if part.is_file() else ():
            if key.endswith("._target_"):
                _compare(raw, name, key, value)
    for key, value in _values(file):
        _compare(raw, name, key, value)


def check_original(choices: Mapping[str, str]) -> None:
    """Refuses the experiment of an original publication on another recipe than that of the paper's scale.

    Such a file changes what differs from that recipe alone: with another one, a run would be neither of the two.

    Args:
        choices: group -> word.

    Raises:
        UserError: the scale is another one.
    """
    name, scale = choices.get("experiment", ""), choices.get("scale")
    if name.endswith("_original") and scale != "paper":
        raise UserError(
            f"+experiment={name} changes the recipe of scale=paper, and this run has scale={scale}, whose sizes, steps "
            f"and schedules are others: leave out scale={scale}, or the experiment."
        )


def explain(sentence: str, choices: Mapping[str, str], conf: Path) -> None:
    """Names the ablation where it is what sets a key that the model does not have.

    Args:
        sentence: what is wrong with a configuration.
        choices: group -> word.
        conf: folder of configuration files.

    Raises:
        UserError: the ablation sets the unknown key.
    """
    name = choices.get("ablation")
    file = conf / "ablation" / f"{name}.yaml"
    unknown = re.match(r"Unknown key ([\w.]+)", sentence)
    if name is None or unknown is None or not file.is_file():
        return
    key = unknown.group(1)
    if any(own == key or own.startswith(f"{key}.") for own, _ in _values(file)):
        raise UserError(
            f"+ablation={name} sets {key}, which model={choices.get('model')} does not have: leave out the ablation, "
            "or choose the model that it is of."
        )


def _compare(raw: Mapping[str, Any], name: str, key: str, value: Any) -> None:
    found = _at(raw, key)
    if not _same(found, value):
        _refuse(name, f"{key}={shown(value)}", f"no {key}" if found is _MISSING else f"{key}={shown(found)}")


def _refuse(name: str, sets: str, found: str) -> None:
    raise UserError(
        f"+ablation={name} sets {sets}, and this run has {found}, so it is not that ablation: "
        "leave out one of them, or describe the run by its values alone."
    )


def _content(file: Path) -> dict[str, Any]:
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


def _swaps(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The choices in a defaults list: (group, word)."""
    for entry in content.get("defaults", ()):
        for key, word in entry.items() if isinstance(entry, dict) else ():
            group = re.sub(r"^(optional |override )*/?", "", key).partition("@")[0]
            if isinstance(word, str) and "${" not in word:
                yield group, word


def _values(file: Path) -> Iterator[tuple[str, Any]]:
    """Every value that a file sets, with its full key."""
    named = _PACKAGE.search(file.read_text(encoding="utf-8"))
    package = named.group(1) if named else ".".join(file.parent.relative_to(file.parents[1]).parts)
    prefix = "" if package == "_global_" else f"{package}."
    content = {key: value for key, value in _content(file).items() if key != "defaults"}
    yield from _leaves(content, prefix)


def _leaves(content: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        elif not (isinstance(value, str) and "${" in value):
            yield f"{prefix}{key}", value


def _at(raw: Any, key: str) -> Any:
    for word in key.split("."):
        if not isinstance(raw, Mapping) or word not in raw:
            return _MISSING
        raw = raw[word]
    return raw


def _same(found: Any, value: Any) -> bool:
    """Equal values; 0 and 0.0 are, 0 and false are not."""
    if isinstance(found, bool) or isinstance(value, bool):
        return found is value
    if isinstance(found, float) and isinstance(value, float) and math.isnan(found) and math.isnan(value):
        return True
    return bool(found == value)

"""The options and words of a command line before Hydra reads them; what is refused is one sentence."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hydra._internal.utils import get_args_parser

from apex_lab.base.errors import UserError
from apex_lab.base.validation import sentence
from apex_lab.config.composition import full_names

_COMPLETION = re.compile(r"(install|uninstall|query)=(bash|zsh|fish)")

_ALONE = ("run", "multirun", "cfg", "info", "shell_completion")


def options() -> argparse.Namespace:
    """The options on this process's command line, and its words as `overrides`.

    Raises:
        UserError: an option that does not exist, without its value, or beside another that it does not go with.
    """
    asked = _parser().parse_args()
    if asked.help or asked.hydra_help:
        return asked
    if asked.experimental_rerun is not None:
        raise UserError("--experimental-rerun is not read here: the command of a run, typed again, resumes it.")
    if asked.multirun and (asked.cfg or asked.info):
        raise UserError("-m cannot stand beside --cfg or --info: leave it out to see one job's configuration.")
    given = [f"--{name.replace('_', '-')}" for name in _ALONE if getattr(asked, name)]
    if len(given) > 1:
        raise UserError(f"{' and '.join(given)} do not go together: leave out one of them.")
    if asked.resolve and not asked.cfg:
        raise UserError("--resolve goes with --cfg alone: write --cfg job --resolve.")
    if asked.shell_completion and not (len(asked.overrides) == 1 and _COMPLETION.fullmatch(asked.overrides[0])):
        raise UserError("--shell-completion goes with one word alone: install=bash, uninstall=zsh or query=fish.")
    if asked.package is not None and not asked.cfg:
        raise UserError("--package goes with --cfg alone: write --cfg job --package ...")
    return asked


def only_asks(asked: argparse.Namespace) -> bool:
    """Whether a command line asks for help or for its configuration, so that nothing is to be started."""
    return bool(asked.help or asked.hydra_help or asked.info or asked.shell_completion or asked.cfg)


def arrange(literal: Sequence[str] = (), model_groups: bool = True) -> None:
    """Brings this process's command line into the form that Hydra reads: overrides in one piece, so that `-m` may stand
    anywhere; names of files in quotes; full names of groups; home folders (`~`) written out.

    Args:
        literal: keys whose values are names of files.
        model_groups: whether short names of models' groups (`masks=scalor`) are understood.

    Raises:
        UserError: an option that does not exist or lacks its value.
    """
    words = _last([_quoted(word, literal) for word in sys.argv[1:]])
    sys.argv[1:] = [at_home(word) for word in (full_names(words) if model_groups else words)]


def passed_on() -> list[str]:
    """The options of this command, besides its words, that each of its jobs needs."""
    asked = options()
    found = []
    for name in ("config_dir", "config_path"):
        if (value := getattr(asked, name)) is not None:
            found += [f"--{name.replace('_', '-')}", str(Path(value).absolute())]
    if asked.config_name is not None:
        found += ["--config-name", asked.config_name]
    return found


def at_home(word: str) -> str:
    """A word in which `~` or `~name`, at the beginning of its value or of one of several, is that folder.

    A shell does this for a word of its own alone, not behind `key=`; Hydra cannot read it, and quoted for Hydra it
    would be the name of a folder.
    """

    def written_out(found: re.Match[str]) -> str:
        quote, path = found["quote"] or "", found["quoted"] or found["bare"]
        there = os.path.expanduser(path)
        if there == path:  # no such user
            return found[0]
        if not quote and _SPECIAL.search(there):
            quote = '"'
        return f"{found['before']}{quote}{there}{quote}"

    key, equals, value = word.partition("=")
    return f"{key}{equals}{_HOME.sub(written_out, value)}"


_HOME = re.compile(
    r"""(?P<before>^|[\[,]\s*)(?:(?P<quote>["'])(?P<quoted>~[^"']*)(?P=quote)|(?P<bare>~[^"',\]]*))(?=\s*(?:[,\]]|$))"""
)
"""A value, or one of several, that begins in a home folder."""

_SPECIAL = re.compile(r"[^\w/.:+@%-]")
"""What Hydra does not read in a value without quotes, or reads otherwise."""


def _parser() -> argparse.ArgumentParser:
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise UserError(sentence(message[:1].upper() + message[1:]))

    parser.error = refuse  # type: ignore[method-assign,assignment]
    return parser


def _quoted(word: str, literal: Sequence[str]) -> str:
    """The word with its value in quotes, if its key is one of names of files and the value is not a list or quoted."""
    key, equals, value = word.partition("=")
    if key.lstrip("+") not in literal or not equals or value in ("", "null") or value[0] in "['\"":
        return word
    # for OmegaConf a backslash stands for itself, unless it comes before an interpolation
    plain = re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
    # in quotes it does, unless it comes before a quote or the end
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), plain)
    return f"{key}='{escaped}'"


def _last(arguments: Sequence[str]) -> list[str]:
    """The same command line with all overrides in one piece."""
    known, rest = _parser().parse_known_args(list(arguments))
    late = [word for word in rest if not word.startswith("-")]
    if not late:
        return list(arguments)
    early = list(known.overrides)
    rest = list(arguments)
    for word in [*early, *late]:
        rest.remove(word)
    return [*early, *late, *rest]

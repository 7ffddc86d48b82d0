"""Which checkpoint files are meant: files, run folders, patterns, names of shipped weights."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from apex_lab.base.errors import UserError
from apex_lab.base.files import fitting
from apex_lab.base.order import natural_path_key
from apex_lab.base.validation import did_you_mean, sentence, to_open
from apex_lab.config import shipped

Bad = dict[Path, str]
"""What cannot be used -> why, in one sentence."""


def find(patterns: Sequence[str]) -> tuple[list[Path], Bad]:
    """The checkpoint files that are meant, each once, in the order of the patterns; and what holds none.

    Files that a folder or a pattern names are in natural order: seed_2 before seed_10.

    Args:
        patterns: checkpoint files, run folders (their last checkpoint), folders that hold run folders, patterns with
            `*` for any of these, or names of shipped weights (`config.shipped.NAMES`).

    Raises:
        UserError: one of them means no checkpoint; of several things that fit a pattern, some may be without.
    """
    found: dict[Path, Path] = {}
    bad: Bad = {}
    for pattern in patterns:
        matches = _matches(pattern)
        without: Bad = {}
        for path in matches:
            try:
                for file in _files(path):
                    found.setdefault(file.resolve(), file)
            except UserError as error:
                without[path] = str(error)
        if len(without) == len(matches):
            raise UserError(next(iter(without.values())))
        bad |= without
    return list(found.values()), bad


def _matches(pattern: str) -> list[Path]:
    path = to_open("checkpoint", pattern)
    if path.exists():
        return [path]
    if pattern in shipped.NAMES:
        return [shipped.weights(pattern)]
    if not any(mark in pattern for mark in "*?"):
        hint = did_you_mean(pattern, shipped.NAMES) or ": give a .ckpt file or a run folder"
        raise UserError(sentence(f"checkpoint = {pattern} does not exist{hint}"))
    found = sorted(fitting("checkpoint", path), key=natural_path_key)
    if not found:
        raise UserError(f"checkpoint = {pattern} fits nothing: give .ckpt files or run folders.")
    return found


def _files(path: Path) -> list[Path]:
    """The file itself; the last checkpoint of a run; those of all runs in a folder."""
    if not path.is_dir():
        return [path]
    own = path / "checkpoints" / "last.ckpt"
    if own.is_file():
        return [own]
    # a pattern without * would pass over a link that leads nowhere
    files = fitting("checkpoint", Path(glob.escape(str(path))) / "**" / "last.ckpt*")
    inside = [file for file in files if file.name == own.name and file.parent.name == own.parent.name]
    if not inside:
        raise UserError(
            f"checkpoint = {path} is a folder without checkpoints/last.ckpt, and no run folder is in it: "
            "give a .ckpt file or a run folder."
        )
    return sorted(inside, key=natural_path_key)

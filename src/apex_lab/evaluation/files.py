"""Which checkpoint files are meant, and which of them cannot be evaluated: found out before any model is built."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from apex_lab.base.errors import UserError
from apex_lab.base.order import natural_path_key
from apex_lab.base.validation import one_line, sentence, validate
from apex_lab.config import components
from apex_lab.config import schema as config
from apex_lab.evaluation.other_data import OtherData
from apex_lab.runs import checkpoints

Bad = dict[Path, str]
"""What cannot be evaluated -> why, in one sentence."""


def find(patterns: Sequence[str]) -> tuple[list[Path], Bad]:
    """The checkpoint files that are meant, each once, in the order of the patterns; and what holds none.

    Files that a folder or a pattern names are in natural order: seed_2 before seed_10.

    Args:
        patterns: checkpoint files, run folders (their last checkpoint), folders that hold run folders, or patterns
            with `*` for any of these.

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


def look(
    files: Sequence[Path], paths: config.PathsPart, data: OtherData | None = None, trusted: bool = False
) -> tuple[list[Path], Bad]:
    """Tells the files that look like checkpoints, by their configurations alone, from the others.

    A file that has not changed is read once, however often it is asked about.

    Args:
        files: as `find` gives them.
        paths: folders of this machine.
        data: what stands in place of the data that the model was trained with.
        trusted: as of `checkpoints.load`.

    Returns:
        Those that can be tried, and the others with their reasons.
    """
    good: list[Path] = []
    bad: Bad = {}
    for file in files:
        try:
            content = _glance(file, trusted, _stamp(file))
            stored = here(file, content["config"], paths, trusted)
            _checked(file, stored)
            if data:
                components.check(data.instead_of(stored["data"]), "data")
            good.append(file)
        except UserError as error:
            bad[file] = str(error)
    return good, bad


def here(file: Path, stored: Mapping[str, Any], paths: config.PathsPart, trusted: bool) -> dict[str, Any]:
    """The configuration of a checkpoint with the folders of this machine.

    A checkpoint may name another folder for its data. What lies there is read; nothing is made there unless the file is
    trusted, since its author would choose where this machine writes.

    Raises:
        UserError: it has no data or no folders.
    """
    data, then = stored.get("data"), stored.get("paths")
    if not isinstance(data, Mapping) or not isinstance(then, Mapping) or "_target_" not in data:
        raise UserError(f"{file} holds no whole configuration: use another checkpoint.")
    own = {key: paths.data if value == then.get("data") else value for key, value in data.items()}
    if not trusted and own.get("root", paths.data) != paths.data:
        own["generate"] = False
    return {**stored, "data": own, "paths": paths.model_dump()}


def of_another_version(file: Path, error: UserError) -> UserError:
    """The sentence for a configuration that this version refuses."""
    return UserError(sentence(f"{file} holds a configuration that this version of apex_lab refuses: {one_line(error)}"))


def listed(bad: Mapping[Path, str], count: int) -> str:
    """How many of `count` checkpoints were not evaluated, and a line for each with its reason."""
    lines = [reason if str(file) in reason else f"{file}: {reason}" for file, reason in bad.items()]
    return "\n".join([f"{len(bad)} of {count} checkpoints were not evaluated:", *(f"  {line}" for line in lines)])


@functools.lru_cache(maxsize=4096)
def _glance(file: Path, trusted: bool, stamp: tuple[int, int] | None) -> dict[str, Any]:
    return checkpoints.glance(file, trusted)


def _stamp(file: Path) -> tuple[int, int] | None:
    """What changes when a file is written; None where there is none."""
    try:
        about = file.stat()
    except OSError:
        return None
    return about.st_mtime_ns, about.st_size


def _checked(file: Path, stored: Mapping[str, Any]) -> None:
    try:
        validate(config.Config, stored, "")
    except UserError as error:
        raise of_another_version(file, error) from error


def _matches(pattern: str) -> list[Path]:
    path = Path(pattern)
    if path.exists():
        return [path]
    if not any(mark in pattern for mark in "*?"):
        raise UserError(f"checkpoint = {pattern} does not exist: give a .ckpt file or a run folder.")
    start = Path(path.anchor) if path.is_absolute() else Path()
    found = sorted(start.glob(str(path.relative_to(path.anchor))), key=natural_path_key)
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
    inside = [
        file for file in path.rglob("last.ckpt*") if file.name == own.name and file.parent.name == own.parent.name
    ]
    if not inside:
        raise UserError(
            f"checkpoint = {path} is a folder without checkpoints/last.ckpt, and no run folder is in it: "
            "give a .ckpt file or a run folder."
        )
    return sorted(inside, key=natural_path_key)

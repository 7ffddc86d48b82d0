"""Which checkpoint files cannot be evaluated: found out before any model is built."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence, validate
from apex_lab.config import components, limits
from apex_lab.config.schema import Config, PathsPart
from apex_lab.evaluation.other_data import OtherData
from apex_lab.inference.loading import changed
from apex_lab.runs import checkpoints
from apex_lab.runs.checkpoint_files import Bad, find

MANY = 100
"""Checkpoints from which on a look into all of them takes seconds, so that it is announced."""

__all__ = ["Bad", "find", "here", "listed", "look", "of_another_version"]


def look(
    files: Sequence[Path],
    paths: PathsPart,
    data: OtherData | None = None,
    trusted: bool = False,
    batch_size: int = 1,
    chunk: int | None = None,
    model: Mapping[str, Any] | None = None,
) -> tuple[list[Path], Bad]:
    """Tells the files that look like checkpoints, by their configurations alone, from the others.

    A file that has not changed is read once, however often it is asked about.

    Args:
        files: as `find` gives them.
        paths: folders of this machine.
        data: what stands in place of the data that the model was trained with.
        trusted: as of `checkpoints.load`.
        batch_size: videos that will be read at once.
        chunk: frames that the model will see at once; None: all.
        model: arguments of the model that are to have other values.

    Returns:
        Those that can be tried, and the others with their reasons.
    """
    good: list[Path] = []
    bad: Bad = {}
    if len(files) - _glance.cache_info().currsize >= MANY:
        console.put(f"{len(files)} checkpoints: looking into each\n", error=True)
    for file in files:
        try:
            content = _glance(file, trusted, _stamp(file))
            stored = here(file, content["config"], paths, trusted)
            _checked(file, stored)
            if model:
                changed(stored["model"], model)
            node = data.instead_of(stored["data"]) if data else stored["data"]
            if data:
                components.check(node, "data")
            limits.refuse_large_videos(node, batch_size, chunk, "batch_size")
            good.append(file)
        except UserError as error:
            bad[file] = str(error)
    return good, bad


def here(file: Path, stored: Mapping[str, Any], paths: PathsPart, trusted: bool) -> dict[str, Any]:
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
    if not trusted and own.get("root", paths.data) != paths.data and components.takes(own, "data", "generate"):
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
        validate(Config, stored, "")
    except UserError as error:
        raise of_another_version(file, error) from error

"""`init_from`: weights that training starts from, told by what they are, not by where they lie. Imports no PyTorch.

A composed configuration has `init_from: {checkpoint: ..., weights: <SHA-256>}` in place of the word that was given, so
a run's name depends on the weights alone. Nothing that a file names is built: its tensors are all that is read.
"""

from __future__ import annotations

import functools
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.machine import bounded_memory
from apex_lab.base.outlines import Placed, digest, outline
from apex_lab.base.validation import did_you_mean, openable, sentence, shown
from apex_lab.config import shipped

KEY = "init_from"

Sizes = Mapping[str, tuple[int, ...]]
"""Name of a weight -> its size."""


@dataclass(frozen=True)
class Stored:
    """The weights of a checkpoint file.

    Attributes:
        digest: SHA-256 of names, types, sizes and values.
        sizes: of each.
    """

    digest: str
    sizes: Sizes


def identified(value: object, outputs: object) -> dict[str, str]:
    """What stands in a configuration for the weights that were asked for.

    A run goes on without the file that it began with: where there is none any more, the runs that began with it tell
    which weights it held.

    Args:
        value: a checkpoint file, a run folder (its last checkpoint), or the name of shipped weights.
        outputs: `paths.outputs`.

    Returns:
        `checkpoint`, the absolute path or the name, and `weights`, their digest.

    Raises:
        UserError: there are no such weights.
    """
    if not isinstance(value, str):
        known = " or ".join(shipped.NAMES)
        raise UserError(f"{KEY} = {shown(value)} is wrong: give a checkpoint file, a run folder, or {known}.")
    try:
        named = not os.path.exists(openable(value)) and value in shipped.NAMES
    except ValueError as error:
        raise UserError(f"{KEY} = {shown(value)} is wrong: {error}.") from error
    where = value if named else os.path.abspath(value)
    try:
        file = file_of(value)
    except UserError:
        remembered = _remembered(where, outputs)
        if len(remembered) > 1:
            raise UserError(
                f"{KEY} = {value} is gone, and runs in {outputs} began with {len(remembered)} versions of it: put the "
                "file back."
            ) from None
        if not remembered:
            raise
        return {"checkpoint": where, "weights": remembered.pop()}
    return {"checkpoint": where, "weights": stored(file).digest}


def file_of(where: str) -> Path:
    """The checkpoint file that is meant.

    Args:
        where: a file, a run folder, or the name of shipped weights.

    Raises:
        UserError: it is not there.
    """
    path, last = Path(where), Path(where, "checkpoints", "last.ckpt")
    if os.path.isfile(path):
        return path
    if os.path.isfile(last):
        return last
    if os.path.exists(path):
        raise UserError(f"{KEY} = {where} holds no checkpoints/last.ckpt: give a .ckpt file or a run folder.")
    if where in shipped.NAMES:
        return shipped.weights(where)
    hint = did_you_mean(where, shipped.NAMES) or ": give a .ckpt file or a run folder"
    raise UserError(sentence(f"{KEY} = {where} does not exist{hint}"))


def stored(file: Path) -> Stored:
    """The weights of a checkpoint file; one that has not changed is read once.

    Raises:
        UserError: it is damaged or no checkpoint.
    """
    try:
        about = file.stat()
    except OSError as error:
        raise UserError(f"{KEY} = {file} cannot be read ({error.strerror}): give another checkpoint.") from error
    return _stored(file, about.st_mtime_ns, about.st_size)


@functools.lru_cache(maxsize=64)
def _stored(file: Path, changed: int, size: int) -> Stored:
    try:
        with bounded_memory():
            with zipfile.ZipFile(file) as archive:
                if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                    raise UserError(f"{KEY} = {file} is no apex_lab checkpoint (its parts are compressed).")
            content = outline(file)
            inside = content.get("inference", content)
            weights = dict(inside["weights"])
            if not weights or not all(isinstance(place, Placed) for place in weights.values()):
                raise UserError(f"{KEY} = {file} holds no weights: give a .ckpt file of a run, or the run's folder.")
            return Stored(digest(file, weights), {str(name): place.size for name, place in weights.items()})
    except UserError:
        raise
    except Exception as error:  # what is raised for damaged bytes has no common class
        raise UserError(
            f"{KEY} = {file} is damaged or no checkpoint ({type(error).__name__}): give a .ckpt file of a run, or the "
            "run's folder."
        ) from error


def _remembered(where: str, outputs: object) -> set[str]:
    """Digests of the weights that runs have found at a place."""
    found = set()
    for file in Path(outputs).glob("*/seed_*/run.json") if isinstance(outputs, str) else ():
        try:
            about = read_json(file).get(KEY)
        except UserError:
            continue
        if isinstance(about, Mapping) and about.get("checkpoint") == where:
            weights = about.get("weights")
            if isinstance(weights, str) and re.fullmatch(DIGEST, weights):
                found.add(weights)
    return found


DIGEST = "[0-9a-f]{64}"


def misfit(there: Sizes, here: Sizes) -> str | None:
    """What keeps weights from fitting a model, in a few words; None where they fit.

    Args:
        there: of the file.
        here: of the model.
    """
    other = [name for name, size in here.items() if there.get(name, size) != size]
    missing = [name for name in here if name not in there]
    unknown = [name for name in there if name not in here]
    parts = [
        _some([f"{name} is {_size(there[name])} there and {_size(here[name])} here" for name in other]),
        f"the file lacks {_some(missing)}" if missing else "",
        f"the model has no {_some(unknown)}" if unknown else "",
    ]
    return "; ".join(part for part in parts if part) or None


def _size(size: Sequence[int]) -> str:
    return " x ".join(map(str, size)) or "a number"


def _some(words: Sequence[str], most: int = 3) -> str:
    rest = len(words) - most
    return ", ".join(words[:most]) + (f" and {rest} more" if rest > 0 else "")


def refuse_misfit(about: Any, here: Sizes) -> None:
    """Compares the weights that a configuration names with a model's, as far as the file is still there.

    Args:
        about: `init_from` of a checked configuration.
        here: sizes of the model's weights.

    Raises:
        UserError: they do not fit.
    """
    try:
        file = file_of(about.checkpoint)
    except UserError:
        return  # a run that has begun needs it no more
    told = misfit(stored(file).sizes, here)
    if told is not None:
        raise UserError(f"{KEY} = {about.checkpoint} does not fit the model: {told}.")

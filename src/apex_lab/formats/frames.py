"""Which file is which frame: by the number in its name, never by its place in a list (metrics.md section 6)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from apex_lab.base.errors import UserError

_NUMBER = re.compile(r"(\d+)", re.ASCII)


def numbered(files: Sequence[Path], where: str) -> dict[int, Path]:
    """The files of one video by the number of their frame, ascending.

    The number is the one part of the names that differs from file to file (the last one of a single file), so
    `mask_2_0001.png` counts like `1.png`.

    Args:
        files: at least one.
        where: for messages.

    Raises:
        UserError: names that do not count frames: without a number, with other texts around it, with several numbers
            that differ, or two files of one number.
    """
    parts = {file: _NUMBER.split(file.stem) for file in files}
    first = files[0]
    advice = "name the frames by their number alone, as 00000.png, 00001.png"
    for file in files:
        if len(parts[file]) == 1:
            raise UserError(f"{where}: the name {file.name} holds no number of a frame; {advice}")
        if parts[file][::2] != parts[first][::2]:
            raise UserError(f"{where}: {first.name} and {file.name} differ in more than a number; {advice}")
    places = range(1, len(parts[first]), 2)
    differ = [place for place in places if len({int(parts[file][place]) for file in files}) > 1]
    if len(differ) > 1:
        raise UserError(
            f"{where}: the names {first.name}, {files[-1].name}, ... hold several numbers that differ; {advice}"
        )
    place = differ[0] if differ else places[-1]
    found: dict[int, Path] = {}
    for file in files:
        number = int(parts[file][place])
        if number in found:
            raise UserError(
                f"{where}: {found[number].name} and {file.name} are both frame {number}; remove one of them"
            )
        found[number] = file
    return dict(sorted(found.items()))


def check_pairs(predicted: Sequence[int] | None, true: Sequence[int] | None, where: str) -> None:
    """Refuses frames of a prediction and of the ground truth that do not pair by number.

    Args:
        predicted: numbers of the prediction's frames, ascending; None where frames have a place and no number.
        true: of the ground truth's.
        where: file and video, for messages.

    Raises:
        UserError: both are numbered, but not alike; or one is, but not without gaps from 0 or 1 on, so that the place
            of its frames is not known.
    """
    if predicted is not None and true is not None:
        if list(predicted) != list(true):
            strange = sorted(set(predicted) ^ set(true))[0]
            side = "the prediction" if strange in set(predicted) else "the ground truth"
            raise UserError(
                f"{where}: the prediction has {_words(predicted)}, the ground truth {_words(true)}: frame {strange} is "
                f"in {side} alone; number the frames alike"
            )
        return
    for side, numbers in (("prediction", predicted), ("ground truth", true)):
        if numbers is not None and list(numbers) != list(range(numbers[0], numbers[0] + len(numbers))):
            missing = next(n for n in range(numbers[0], numbers[-1]) if n not in set(numbers))
            raise UserError(
                f"{where}: the {side} has {_words(numbers)}, but no frame {missing}; number them without gaps"
            )
        if numbers is not None and numbers[0] > 1:
            raise UserError(
                f"{where}: the {side} has {_words(numbers)}; number them from 0 (or 1) on, or give the rest"
            )


def _words(numbers: Sequence[int]) -> str:
    if len(numbers) == 1:
        return f"frame {numbers[0]}"
    return f"{len(numbers)} frames from {numbers[0]} to {numbers[-1]}"

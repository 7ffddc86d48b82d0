"""TensorBoard's event files: cut back to a step, so that a run that goes on there logs nothing twice."""

from __future__ import annotations

import os
import struct
from pathlib import Path

from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event

from apex_lab.base.files import unwritable
from apex_lab.data.sketchy.tfrecord import masked_checksum

PATTERN = "events.out.tfevents.*"
_HEAD = struct.Struct("<QI")
_CHECKSUM = struct.Struct("<I")


def cut(folder: Path, step: int) -> set[tuple[str, int]]:
    """Takes out of a run's event files what was logged after a step, and what a kill has left half written.

    Files are only shortened, never written anew: a TensorBoard that watches them goes on reading.

    Args:
        folder: of the files; need not exist.
        step: the last to stay.

    Returns:
        (tag, step) of every value that is there.

    Raises:
        UserError: a file cannot be read or shortened.
    """
    points: set[tuple[str, int]] = set()
    for file in sorted(folder.glob(PATTERN)):
        try:
            end, found = _up_to(file, step)
            if end == 0:
                file.unlink()
            elif end < file.stat().st_size:
                os.truncate(file, end)
        except OSError as error:
            raise unwritable(file, error) from error
        points |= found
    return points


def _up_to(path: Path, step: int) -> tuple[int, set[tuple[str, int]]]:
    """Where the first record begins that is not whole or belongs to a later step, and the values before it."""
    points: set[tuple[str, int]] = set()
    size, end = path.stat().st_size, 0
    with open(path, "rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            if checksum != masked_checksum(head[:8]) or end + length > size:
                break
            data, footer = file.read(length), file.read(_CHECKSUM.size)
            if len(footer) < _CHECKSUM.size or _CHECKSUM.unpack(footer)[0] != masked_checksum(data):
                break
            try:
                event = Event.FromString(data)
            except DecodeError:
                break
            if event.step > step:
                break
            points |= {(value.tag, event.step) for value in event.summary.value}
            end = file.tell()
    return end, points

"""Reads a run file of wandb back: records of protocol buffers in the log format of LevelDB.

https://github.com/google/leveldb/blob/main/doc/log_format.md: blocks of 32 KiB, in each pieces with a header of a
checksum (4 bytes), a length (2) and a kind (1: whole, 2: first, 3: middle, 4: last). A header of 7 bytes is
wandb's own.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from wandb.proto import wandb_internal_pb2 as pb

BLOCK, HEADER = 32768, 7


def records(path: Path) -> list[pb.Record]:
    """All whole records; a kill may have cut off the last one."""
    return [pb.Record.FromString(content) for content in _contents(path.read_bytes())]


def _contents(data: bytes) -> Iterator[bytes]:
    assert data[:4] == b":W&B"
    place, parts = HEADER, b""
    while place + HEADER <= len(data):
        left = BLOCK - place % BLOCK
        if left < HEADER:
            place += left
            continue
        length, kind = struct.unpack_from("<HB", data, place + 4)
        piece = data[place + HEADER : place + HEADER + length]
        if kind not in (1, 2, 3, 4) or len(piece) < length:
            return
        parts += piece
        if kind in (1, 4):
            yield parts
            parts = b""
        place += HEADER + length


def _values(items: Any) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for item in items:
        *path, last = item.nested_key or [item.key]
        inside = values
        for key in path:
            inside = inside.setdefault(key, {})
        inside[last] = json.loads(item.value_json)
    return values


def history(found: list[pb.Record]) -> list[dict[str, Any]]:
    """The rows that were logged."""
    return [
        {**_values(one.history.item), "_step": one.history.step.num}
        for one in found
        if one.WhichOneof("record_type") == "history"
    ]


def summary(found: list[pb.Record]) -> dict[str, Any]:
    """The last value of each key of the summary."""
    values: dict[str, Any] = {}
    for one in found:
        if one.WhichOneof("record_type") == "summary":
            values.update(_values(one.summary.update))
    return values


def run(found: list[pb.Record]) -> pb.RunRecord:
    """What the run is."""
    [about] = [one.run for one in found if one.WhichOneof("record_type") == "run"]
    return about


def config(found: list[pb.Record]) -> dict[str, Any]:
    """The configuration that was sent."""
    return _values(run(found).config.update)

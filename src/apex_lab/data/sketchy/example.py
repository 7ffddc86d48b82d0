"""`tf.train.Example` messages: wanted features decoded from protocol buffer bytes, all others skipped.

An Example holds a map from names to features; a feature is a list of byte strings, of float32 or of int64 numbers,
packed or one by one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from apex_lab.data.sketchy.tfrecord import DamagedFileError

Feature = list[bytes] | np.ndarray
"""Byte strings, or numbers (N,) float32 or int64."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_STRINGS, _FLOATS, _INTEGERS = 1, 2, 3
"""Numbers of the fields of a feature."""


def read_features(message: bytes, wanted: Collection[str] | None = None) -> dict[str, Feature]:
    """The features of an Example by name.

    Args:
        message: its bytes.
        wanted: names of the features to decode; None: all.

    Returns:
        Those of `wanted` that the message has. A feature without a list is left out.

    Raises:
        DamagedFileError: it is no Example.
    """
    found: dict[str, Feature] = {}
    for features in _parts(memoryview(message), 1):
        for entry in _parts(features, 1):
            name = _name(entry)
            if wanted is None or name in wanted:
                values = _values(entry)
                if values is None:
                    found.pop(name, None)  # of equal names the last one counts
                else:
                    found[name] = values
    return found


def _name(entry: memoryview) -> str:
    name = b""
    for part in _parts(entry, 1):
        name = bytes(part)
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise DamagedFileError("the name of a feature is not UTF-8") from None


def _values(entry: memoryview) -> Feature | None:
    """The values of an entry's feature; of several lists the last one counts."""
    values: Feature | None = None
    for feature in _parts(entry, 2):
        for number, wire, part in _fields(feature):
            if number in (_STRINGS, _FLOATS, _INTEGERS) and wire == _BYTES:
                assert isinstance(part, memoryview)
                values = (_strings, _floats, _integers)[number - 1](part)
    return values


def _strings(message: memoryview) -> Feature:
    return [bytes(part) for part in _parts(message, 1)]


def _floats(message: memoryview) -> Feature:
    pieces = []
    for number, wire, part in _fields(message):
        if number == 1 and wire in (_BYTES, _FIXED32):
            assert isinstance(part, memoryview)
            if len(part) % 4:
                raise DamagedFileError("a list of floats has a broken length")
            pieces.append(np.frombuffer(part, dtype="<f4"))
    return np.concatenate(pieces).astype(np.float32) if pieces else np.zeros(0, np.float32)


def _integers(message: memoryview) -> Feature:
    values: list[int] = []
    for number, wire, part in _fields(message):
        if number == 1 and wire == _VARINT:
            assert isinstance(part, int)
            values.append(part)
        elif number == 1 and wire == _BYTES:
            assert isinstance(part, memoryview)
            place = 0
            while place < len(part):
                value, place = _varint(part, place)
                values.append(value)
    return np.array(values, dtype=np.uint64).astype(np.int64)  # negative numbers are stored modulo 2^64


def _parts(message: memoryview, wanted: int) -> Iterator[memoryview]:
    """The contents of all length-delimited fields with this number."""
    for number, wire, part in _fields(message):
        if number == wanted and wire == _BYTES:
            assert isinstance(part, memoryview)
            yield part


def _fields(message: memoryview) -> Iterator[tuple[int, int, memoryview | int]]:
    """(number, wire type, content) of each field; the content of a varint is an int, of all others their bytes."""
    place = 0
    while place < len(message):
        tag, place = _varint(message, place)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            value, place = _varint(message, place)
            yield number, wire, value
            continue
        if wire == _BYTES:
            length, place = _varint(message, place)
        elif wire in (_FIXED32, _FIXED64):
            length = 4 if wire == _FIXED32 else 8
        else:
            raise DamagedFileError(f"a field has the unknown type {wire}")
        if place + length > len(message):
            raise DamagedFileError("a field is longer than its message")
        yield number, wire, message[place : place + length]
        place += length


def _varint(message: memoryview, place: int) -> tuple[int, int]:
    """A number of up to 64 bits, 7 per byte, and the place behind it."""
    value = 0
    for count in range(10):
        if place + count >= len(message):
            break
        byte = message[place + count]
        value |= (byte & 0x7F) << 7 * count
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, place + count + 1
    raise DamagedFileError("a number does not end")

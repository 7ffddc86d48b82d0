"""TFRecord files: records with checksums, read in any order without TensorFlow.

A record is the length of its payload (uint64), the checksum of these 8 bytes, the payload, and the checksum of the
payload; all numbers are little-endian. A checksum is CRC-32C (Castagnoli), masked.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import google_crc32c

_LENGTH = struct.Struct("<Q")
_CHECKSUM = struct.Struct("<I")
OVERHEAD = _LENGTH.size + 2 * _CHECKSUM.size
"""Bytes of a record besides its payload."""


class DamagedFileError(Exception):
    """A file that does not hold what it should; the message says what is wrong and in which record, not which file."""


def masked_checksum(data: bytes) -> int:
    """CRC-32C of `data`, masked as in TFRecord files (so that checksums of data with checksums stay good ones)."""
    checksum = google_crc32c.value(data)
    return (((checksum >> 15) | (checksum << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def framed(payload: bytes) -> bytes:
    """A record with its length and checksums."""
    length = _LENGTH.pack(len(payload))
    checksums = (_CHECKSUM.pack(masked_checksum(data)) for data in (length, payload))
    return length + next(checksums) + payload + next(checksums)


class Records:
    """The records of a file: `len(records)`, `records[i]`, iteration in order. A context manager.

    Opening reads and checks the lengths alone, so every record can be reached at once; a payload is checked whenever it
    is read.

    Args:
        path: the file.

    Raises:
        DamagedFileError: it is cut off, or the checksum of a length is wrong.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._file = open(path, "rb")  # noqa: SIM115 - open as long as this object
        try:
            self._places = list(self._lengths())
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> bytes:
        """The payload of a record.

        Raises:
            DamagedFileError: its checksum is wrong.
        """
        start, length = self._places[index]
        self._file.seek(start)
        data = self._file.read(length + _CHECKSUM.size)
        payload, checksum = data[:length], data[length:]
        if len(checksum) != _CHECKSUM.size or _CHECKSUM.unpack(checksum)[0] != masked_checksum(payload):
            raise DamagedFileError(f"the checksum of record {index} is wrong")
        return payload

    def __iter__(self) -> Iterator[bytes]:
        return (self[index] for index in range(len(self)))

    def _lengths(self) -> Iterator[tuple[int, int]]:
        """First byte and length of each payload."""
        size, end = os.fstat(self._file.fileno()).st_size, 0
        for index in itertools.count():
            if end == size:
                return
            self._file.seek(end)
            head = self._file.read(_LENGTH.size + _CHECKSUM.size)
            if len(head) < _LENGTH.size + _CHECKSUM.size:
                raise DamagedFileError(f"it is cut off in record {index}")
            if _CHECKSUM.unpack_from(head, _LENGTH.size)[0] != masked_checksum(head[: _LENGTH.size]):
                raise DamagedFileError(f"the checksum of the length of record {index} is wrong")
            (length,) = _LENGTH.unpack_from(head)
            start = end + len(head)
            end = start + length + _CHECKSUM.size
            if end > size:
                raise DamagedFileError(f"it is cut off in record {index}")
            yield start, length

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> Records:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

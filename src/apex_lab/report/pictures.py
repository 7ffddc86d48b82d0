"""Film strips and movies of runs as text that stands inside the page, within a limit of bytes."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

STRIP, MOVIE = Path("view") / "film_strip.png", Path("view") / "movie.mp4"
"""Where a run's pictures lie in its folder."""

MEGABYTE = 1_000_000

Size = Callable[[bytes], tuple[int, int] | None]
"""Content of a file -> width and height in pixels."""


@dataclass(frozen=True)
class Picture:
    """A picture or movie inside the page.

    Attributes:
        data: its `data:` address.
        width, height: in pixels; None where the file does not say.
    """

    data: str
    width: int | None
    height: int | None


@dataclass
class Budget:
    """How many bytes of the page pictures may still take, and which found no place.

    Attributes:
        left: bytes, counted as they stand in the page (base64: four for three of a file).
        left_out: file -> why it is not in the page.
    """

    left: int
    left_out: dict[Path, str] = field(default_factory=dict)

    def strip(self, folder: Path) -> Picture | None:
        """The film strip of a run, if it has one and there is room."""
        return self._taken(folder / STRIP, "image/png", b"\x89PNG\r\n\x1a\n", 0, _png_size)

    def movie(self, folder: Path) -> Picture | None:
        """The movie of a run, if it has one and there is room."""
        return self._taken(folder / MOVIE, "video/mp4", b"ftyp", 4, _mp4_size)

    def _taken(self, file: Path, kind: str, sign: bytes, at: int, size: Size) -> Picture | None:
        try:
            cost = -(-file.stat().st_size // 3) * 4
        except OSError:
            return None  # no picture was asked for, or it was deleted
        if cost > self.left:
            self.left_out[file] = "no room"
            return None
        try:
            content = file.read_bytes()
        except OSError as error:
            self.left_out[file] = f"cannot be read ({error.strerror})"
            return None
        if content[at : at + len(sign)] != sign:
            self.left_out[file] = f"is no {kind.partition('/')[2].upper()} file"
            return None
        self.left -= cost
        width, height = size(content) or (None, None)
        return Picture(f"data:{kind};base64,{base64.b64encode(content).decode()}", width, height)


def _png_size(content: bytes) -> tuple[int, int] | None:
    """Width and height from a PNG's header."""
    if len(content) < 24:
        return None
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")


def _mp4_size(content: bytes) -> tuple[int, int] | None:
    """Width and height from the first track header of an MP4 that has them."""
    for name, inside in _boxes(content):
        if name == b"tkhd" and len(inside) >= 8:
            # the last two numbers of the header, with 16 bits behind the point
            width, height = int.from_bytes(inside[-8:-4], "big") >> 16, int.from_bytes(inside[-4:], "big") >> 16
            if width and height:
                return width, height
    return None


def _boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The boxes of an MP4, those inside a movie and its tracks too: (name, content)."""
    at = 0
    while at + 8 <= len(content):
        length, name = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        if length < 8:
            return
        inside = content[at + 8 : at + length]
        yield name, inside
        if name in (b"moov", b"trak"):
            yield from _boxes(inside)
        at += length

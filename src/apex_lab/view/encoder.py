"""MP4 files by ffmpeg, frame by frame."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8

from apex_lab.base.errors import UserError
from apex_lab.base.files import unwritable

NEAR_LOSSLESS = ("-crf", "16", "-preset", "slow")
"""For small movies: thin outlines survive."""

SLOWEST = 0.01
"""Frames per second: ffmpeg is told two decimals."""

FAST = ("-crf", "20", "-preset", "veryfast")
"""For long videos."""

TIGHT = 2**20
"""With fewer free bytes a movie that is not whole is taken for one that found no room."""


def ffmpeg() -> str:
    """The ffmpeg program.

    Raises:
        UserError: there is none.
    """
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        program = "ffmpeg"
    found = shutil.which(program)
    if found is None:
        raise UserError(
            f"Movies cannot be made, {program} is no program: "
            "install ffmpeg and set the variable IMAGEIO_FFMPEG_EXE to where it is."
        )
    return found


class Mp4:
    """A movie that is written frame by frame: H.264, yuv420p, which every browser plays (MPEG-4 where ffmpeg lacks it).

    ffmpeg writes to the path itself: give a temporary one. `with` it; when it is left, all frames are in the file.

    Args:
        path: ends in .mp4.
        size: (H, W) in pixels; a row or column is repeated where they are odd.
        fps: frames per second; one in `1 / SLOWEST` seconds at least.
        quality: options of x264.

    Raises:
        UserError: there is no ffmpeg, or the file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float, quality: Sequence[str] = NEAR_LOSSLESS) -> None:
        self.path, self.size, self.written = path, size, 0
        program = ffmpeg()
        h264 = has_h264(program)
        self._even = ((0, size[0] % 2), (0, size[1] % 2), (0, 0))
        self._encoder: Any = imageio_ffmpeg.write_frames(
            str(path),
            (size[1] + size[1] % 2, size[0] + size[0] % 2),
            fps=max(fps, SLOWEST),
            codec="libx264" if h264 else "mpeg4",
            pix_fmt_out="yuv420p",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="fatal",  # its errors are told below
            # the index in front, so that browsers start at once
            output_params=[*(quality if h264 else ("-q:v", "3")), "-movflags", "+faststart", "-threads", "1"],
        )
        self._encoder.send(None)

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Appends an RGB frame.

        Raises:
            UserError: the file cannot be written.
        """
        if any(after for _, after in self._even):
            frame = np.pad(frame, self._even, mode="edge")
        try:
            self._encoder.send(np.ascontiguousarray(frame))
        except OSError as error:
            raise self._cut_off(f"ffmpeg ended after {self.written} frames") from error
        self.written += 1

    def __enter__(self) -> Mp4:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not issubclass(kind, Exception):
            with contextlib.suppress(KeyboardInterrupt):
                self._encoder.throw(KeyboardInterrupt())  # asked to stop: ffmpeg is killed
        self._encoder.close()
        # ffmpeg may fail at its last write, when nobody listens any more
        if kind is None and (count := frames_of(self.path)) != self.written:
            raise self._cut_off(f"ffmpeg wrote {count} of {self.written} frames")

    def _cut_off(self, why: str) -> UserError:
        full = shutil.disk_usage(self.path.absolute().parent).free < TIGHT
        return unwritable(self.path, OSError(errno.ENOSPC, why) if full else OSError(why))


def join(path: Path, parts: Sequence[Path], slower: float = 1.0) -> None:
    """Joins movies of one size, rate and codec, without encoding them again.

    Args:
        path: what to write; a temporary one.
        parts: made by `Mp4`; their paths are those of files beside or below the folder of `path`.
        slower: how many times as long the frames are shown as in the parts.

    Raises:
        UserError: ffmpeg cannot.
    """
    names = path.with_name(f"{path.name}.txt")
    names.write_text("".join(f"file '{os.path.relpath(part, path.parent)}'\n" for part in parts), encoding="utf-8")
    stretched = [] if slower == 1 else ["-itsscale", f"{slower:.9g}"]
    source = [*stretched, "-f", "concat", "-safe", "0", "-i", str(names)]
    options = [*source, "-c", "copy", "-movflags", "+faststart", "-y", str(path)]
    ended = subprocess.run(
        [ffmpeg(), "-v", "error", *options], capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    names.unlink()
    if ended.returncode != 0:
        raise unwritable(path, OSError(ended.stderr.strip() or f"ffmpeg ended with code {ended.returncode}"))


def frames_of(path: Path) -> int:
    """Frames of a movie; 0 if it cannot be read."""
    if not path.exists():
        return 0
    try:
        return imageio_ffmpeg.count_frames_and_secs(str(path))[0]
    except RuntimeError:  # what imageio_ffmpeg raises for a file that ffmpeg cannot open
        return 0


@cache
def has_h264(program: str) -> bool:
    """Whether this ffmpeg can write H.264."""
    ended = subprocess.run(
        [program, "-hide_banner", "-encoders"], capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    return "libx264" in ended.stdout

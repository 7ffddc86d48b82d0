"""One way to read videos: `open_video(source)` for a file, a folder of pictures or a camera, frame by frame.

Frames are 8-bit RGB, turned as the file's metadata (EXIF, display matrix) asks. A frame comes with its time, so that
videos of a variable frame rate keep theirs: every stored frame is one frame here. Only one frame is held in memory.
"""

from __future__ import annotations

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from apex_lab.base.errors import UserError
from apex_lab.base.validation import short
from apex_lab.videos.pictures import is_picture, pages_of, pictures_in, read_pages

Source = Path | int
"""A file or a folder of pictures; the number of a camera."""

SPARE_BYTES = 2**25
"""Memory that is free when a frame is decoded, beside that for the frame."""

STILLS_PER_SECOND = 10.0
"""Nominal, for pictures, which have no times."""

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what is wrong with a file is said here in one sentence


@dataclass(frozen=True)
class Frame:
    """One frame of a video.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        time: seconds since the first frame; pictures without times have `STILLS_PER_SECOND`.
    """

    image: UInt8[np.ndarray, "H W 3"]
    time: float


class Video(ABC):
    """A video that can be read.

    Attributes:
        source: where it comes from.
        name: of the file without its ending, of the folder, or `camera_0`.
        size: (H, W) in pixels of its frames, after rotation.
        fps: frames per second, on average; None where nothing says so.
        announced: how many frames there are by what the file says, which may be wrong; None: not known, or a camera.
        live: a camera: it has no end, and can be read once.
    """

    source: Source
    name: str
    size: tuple[int, int]
    fps: float | None = None
    announced: int | None = None
    live: bool = False

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[Frame]:
        """The frames from number `start` on, one after the other.

        Raises:
            UserError: a frame is damaged or of another size than the first.
        """

    @abstractmethod
    def stamp(self) -> str:
        """32 hex digits that change when the file changes (its path, size and time of writing)."""

    def cut_off(self, frames: int, last: float) -> str | None:
        """What to say where clearly less could be read than the file announces; None where it is whole.

        Many files announce a duration alone. Its frames are then counted at one rate, which is wrong for videos of a
        variable rate; so what counts is how far the times reach.

        Args:
            frames: how many were read, up to the end.
            last: time of the last of them, in seconds.
        """
        if self.announced is None or frames >= self.announced:
            return None
        if self.fps is not None:
            wanted = self.announced / self.fps
            if last + 1 / self.fps >= wanted - max(2 / self.fps, 0.1, 0.01 * wanted):
                return None
        return (
            f"it announces {self.announced} frames, and {frames} could be read: it may be cut off or damaged "
            "(a trimmed video and longer sound announce too many, too)"
        )


def open_video(source: Source | str) -> Video:
    """A video of any kind; its first frame is read, to see that it can be.

    Args:
        source: a file, a folder of pictures, or a camera's number.

    Raises:
        UserError: missing, empty, no video, damaged: one sentence that names it.
    """
    if isinstance(source, int) or (isinstance(source, str) and source.isdecimal() and not Path(source).exists()):
        return Camera(camera_number(source))
    path = Path(source)
    if path.is_dir():
        return PictureFolder(path)
    if not path.is_file():
        raise UserError(f"There is no video at {path}.")
    if path.stat().st_size == 0:
        raise UserError(f"{path} is empty (0 bytes): copy it again.")
    try:
        path.open("rb").close()
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): choose its permissions.") from error
    return PictureFile(path) if is_picture(path) else VideoFile(path)


def camera_number(source: str | int) -> int:
    """The number of a camera.

    Raises:
        UserError: no camera has it.
    """
    digits = str(source)
    if not digits.isdecimal() or len(digits) > 9:
        raise UserError(f"video = {short(digits)} is no camera: they are numbered from 0 on.")
    return int(digits)


class VideoFile(Video):
    """A file that OpenCV's ffmpeg decodes."""

    def __init__(self, path: Path) -> None:
        self.source, self.name = path, path.stem
        capture = self._capture()
        rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        image = _next(capture)
        capture.release()
        if image is None:
            raise UserError(f"{path} is no video that can be read, or it holds no frame.")
        self.size = image.shape[:2]
        self.fps = rate if 0 < rate < 1000 else None  # files without a rate claim the ticks of their clock
        self.announced = int(count) if 0 < count < 2**40 else None

    def frames(self, start: int = 0) -> Iterator[Frame]:
        capture = self._capture()
        try:
            # Jumps land beside the frame in videos of a variable rate or without an index; decoding does not.
            clock, number = _Clock(self.fps), 0
            while number < start and capture.grab():
                clock.time(capture)
                number += 1
            while number >= start and (image := _next(capture)) is not None:
                _check_size(image, self.size, f"{self.source}, frame {number}")
                yield Frame(image, clock.time(capture))
                number += 1
        finally:
            capture.release()

    def stamp(self) -> str:
        return _stamp([Path(str(self.source))])

    def _capture(self) -> cv2.VideoCapture:
        return _opened(str(self.source), cv2.CAP_FFMPEG)


class _Clock:
    """Times of decoded frames, counted from the first; where they stand still, the rate goes on."""

    def __init__(self, fps: float | None) -> None:
        self._step = 1 / (fps or STILLS_PER_SECOND)
        self._first: float | None = None
        self._last = 0.0

    def time(self, capture: Any) -> float:
        """Seconds of the frame that was decoded last."""
        now = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if self._first is None:
            self._first = now
            return 0.0
        now -= self._first
        self._last = now if np.isfinite(now) and now > self._last else self._last + self._step
        return self._last


class PictureFile(Video):
    """One picture, an animation or a stack of pictures in a file."""

    def __init__(self, path: Path) -> None:
        self.source, self.name, self._path = path, path.stem, path
        self.announced = pages_of(path)
        image, shown = next(read_pages(path))
        self.size = image.shape[:2]
        self.fps = 1 / shown if shown and self.announced > 1 else None

    def frames(self, start: int = 0) -> Iterator[Frame]:
        time = 0.0
        for number, (image, shown) in enumerate(read_pages(self._path)):
            if number >= start:
                _check_size(image, self.size, f"{self._path}, frame {number}")
                yield Frame(image, time)
            time += shown or 1 / STILLS_PER_SECOND

    def stamp(self) -> str:
        return _stamp([self._path])


class PictureFolder(Video):
    """A folder whose pictures, in natural order of their names, are the frames."""

    def __init__(self, path: Path) -> None:
        self.source, self.name = path, path.resolve().name
        self._files = pictures_in(path)
        if not self._files:
            raise UserError(f"{path} is a folder without pictures: give a video file or a folder of pictures.")
        self.announced = len(self._files)
        self.size = next(read_pages(self._files[0]))[0].shape[:2]

    def frames(self, start: int = 0) -> Iterator[Frame]:
        for number, file in enumerate(self._files[start:], start):
            image, _ = next(read_pages(file))
            _check_size(image, self.size, str(file))
            yield Frame(image, number / STILLS_PER_SECOND)

    def stamp(self) -> str:
        return _stamp(self._files)


class Camera(Video):
    """A camera of this machine; it is opened here and released when its frames end."""

    live = True

    def __init__(self, number: int) -> None:
        self.source, self.name = number, f"camera_{number}"
        self._capture = _opened(number)
        self._first = _next(self._capture)
        if self._first is None:
            self._capture.release()
            raise UserError(f"Camera {number} gives no picture: check that it is connected and free, or give a file.")
        self.size = self._first.shape[:2]
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = rate if 0 < rate < 1000 else None

    def frames(self, start: int = 0) -> Iterator[Frame]:
        if self._first is None or start:
            raise UserError(f"Camera {self.source} can be read once, from now on.")
        image: np.ndarray | None = self._first
        self._first = None
        ticks = cv2.getTickCount()
        try:
            while image is not None:
                _check_size(image, self.size, f"camera {self.source}")
                yield Frame(image, (cv2.getTickCount() - ticks) / cv2.getTickFrequency())
                image = _next(self._capture)
        finally:
            self._capture.release()

    def stamp(self) -> str:
        return hashlib.sha256(self.name.encode()).hexdigest()[:32]


def _opened(*what: Any) -> Any:
    """A `cv2.VideoCapture`, opened without OpenCV's own messages: what is wrong is said here in one sentence."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(*what)
    finally:
        cv2.utils.logging.setLogLevel(level)


def _next(capture: Any) -> UInt8[np.ndarray, "H W 3"] | None:
    """The next frame as RGB; None at the end, and where there is nothing to read.

    Raises:
        MemoryError: there may be too little for it.
    """
    pixels = capture.get(cv2.CAP_PROP_FRAME_HEIGHT) * capture.get(cv2.CAP_PROP_FRAME_WIDTH)
    _memory_for(int(pixels) if 0 < pixels < 2**31 else 0)
    found, image = capture.read()
    if not found or image is None or image.size == 0:
        return None
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)


def _memory_for(pixels: int) -> None:
    """Asks the system for as much as a frame may need and gives it back: without memory OpenCV's decoder leaves frames
    out, or gives an old one for a new one, and does not say so.

    Raises:
        MemoryError: that much is not there.
    """
    np.empty(SPARE_BYTES + 48 * pixels, dtype=np.uint8)


def _check_size(image: np.ndarray, size: tuple[int, int], where: str) -> None:
    if image.shape[:2] != size:
        raise UserError(
            f"{where} is {image.shape[1]} x {image.shape[0]} pixels, the first frame {size[1]} x {size[0]}: "
            "give videos whose frames have one size."
        )


def _stamp(files: list[Path]) -> str:
    about = [(str(file.resolve()), (found := file.stat()).st_size, found.st_mtime_ns) for file in files]
    return hashlib.sha256(repr(about).encode()).hexdigest()[:32]

"""Predictions as DAVIS-style PNGs: a folder per video, a palette image per frame, its index the identity.

Identities are numbered 1, 2, ... per video in the order of their values; index 0 is the background where it is known.
What identities are called does not matter to any metric, so nothing is lost. A palette has room for 255 of them.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image, UnidentifiedImageError

from apex_lab.base.errors import UserError
from apex_lab.formats.video import PredictedVideo

MAX_INDEX = 255


class DavisWriter:
    """Writes videos one at a time, each as a sub-folder of `path`; a folder of the same name is replaced.

    Args:
        path: the folder.
        truth: write `PredictedVideo.truth` in place of the prediction; labels are the indices.
    """

    def __init__(self, path: str | Path, truth: bool = False) -> None:
        self.path, self.truth = Path(path), truth
        self.path.mkdir(parents=True, exist_ok=True)

    def add(self, video: PredictedVideo) -> None:
        """Writes one video.

        Raises:
            UserError: more identities than a palette can tell apart, or a name that is no folder name.
        """
        folder = self.path / plain_name(video.name)
        draft = self.path / f".{video.name}"
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        for t, frame in enumerate(self._indices(video)):
            image = Image.fromarray(frame, mode="P")
            image.putpalette(palette().tobytes())
            image.save(draft / f"{t:05d}.png")
        if folder.exists():
            shutil.rmtree(folder)
        draft.rename(folder)

    def _indices(self, video: PredictedVideo) -> UInt8[np.ndarray, "T H W"]:
        if self.truth:
            if video.truth is None:
                raise ValueError(f"video {video.name!r} has no ground truth to write")
            largest, indices = int(video.truth.max()), video.truth
        else:
            names, inverse = np.unique(video.identities, return_inverse=True)
            is_background = np.isin(names, list(video.background_ids))
            index = np.where(is_background, 0, np.cumsum(~is_background))
            largest, indices = int(index.max()), index[inverse].reshape(video.identities.shape)
        if largest > MAX_INDEX:
            raise UserError(
                f"video {video.name!r} has {largest} identities, a palette image tells {MAX_INDEX} apart; "
                "export it as npz"
            )
        return indices.astype(np.uint8)

    def __enter__(self) -> DavisWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is left open."""


def video_names(path: str | Path) -> list[str]:
    """The sub-folders of a folder that hold PNGs, in order."""
    return sorted({image.parent.name for image in Path(path).glob("[!.]*/*.png")})


def read_davis(path: str | Path, name: str) -> Int64[np.ndarray, "T H W"]:
    """Indices of one video, frames in the order of their file names.

    Raises:
        UserError: no such video, images of different sizes, or with colours in place of indices.
    """
    files = sorted((Path(path) / name).glob("*.png"))
    if not files:
        raise UserError(f"{path} has no folder {name} with PNGs, one per frame")
    frames = [_indices_of(file) for file in files]
    for file, frame in zip(files, frames, strict=True):
        if frame.shape != frames[0].shape:
            raise UserError(f"{file} has the size {frame.shape}, the first frame {frames[0].shape}")
    return np.stack(frames)


def _indices_of(file: Path) -> Int64[np.ndarray, "H W"]:
    try:
        with Image.open(file) as image:
            if image.mode not in ("P", "L"):
                raise UserError(f"{file} is a {image.mode} image; want one index per pixel (a palette or grey image)")
            return np.asarray(image).astype(np.int64)
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise UserError(f"{file} is no readable PNG ({error})") from error


def palette() -> UInt8[np.ndarray, "256 3"]:
    """The colours that PASCAL VOC and DAVIS give to indices: their bits, dealt to red, green and blue in turn."""
    index = np.arange(256)
    colours = np.zeros((256, 3), dtype=np.uint8)
    for position in range(8):
        level, channel = divmod(position, 3)
        colours[:, channel] |= (((index >> position) & 1) << (7 - level)).astype(np.uint8)
    return colours


def plain_name(name: str) -> str:
    """A video's name, if it can name a file or folder.

    Raises:
        UserError: it cannot.
    """
    if not name or name.startswith(".") or any(c in name for c in "/\\:\0"):
        raise UserError(f"the video name {name!r} cannot be a file name; give the video another, or export it as npz")
    return name

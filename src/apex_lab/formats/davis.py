"""Predictions as DAVIS-style PNGs: a folder per video, a palette image per frame, its index the identity.

Identities are numbered 1, 2, ... per video in the order of their values; index 0 is the background where it is known.
No metric depends on the values of identities, so nothing is lost. A palette has room for 254 of them: 255
is DAVIS's mark of pixels to ignore, and in ground truth the ignored label is written so.

Palette and grey images are read, of 1 to 16 bits. The number in a file's name is its frame.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image, UnidentifiedImageError

from apex_lab.base.errors import UserError
from apex_lab.base.files import draft_of
from apex_lab.base.order import natural_key
from apex_lab.base.signed import is_signed, signature
from apex_lab.formats.frames import numbered
from apex_lab.formats.video import PredictedVideo, labels_of

VOID_INDEX = 255
MAX_INDEX = 254

LABEL_MODES = ("P", "L", "1", "I", "I;16", "I;16B", "I;16L")
"""Pillow's names of images with one number per pixel; 16-bit PNGs are I;16, or I in older versions."""


class DavisWriter:
    """Writes videos one at a time, each as a sub-folder of `path`; frames that it wrote there before are replaced.

    Args:
        path: the folder.
        truth: write `PredictedVideo.truth` in place of the prediction; labels are the indices.
        ignore_label: this true label becomes index 255.
    """

    def __init__(self, path: str | Path, truth: bool = False, ignore_label: int | None = None) -> None:
        self.path, self.truth, self.ignore_label = Path(path), truth, ignore_label
        self.path.mkdir(parents=True, exist_ok=True)

    def add(self, video: PredictedVideo) -> None:
        """Writes one video.

        Raises:
            UserError: more identities than a palette can tell apart, or a name that is no folder name.
        """
        folder = self.path / plain_name(video.name)
        indices = self._indices(video)
        folder.mkdir(exist_ok=True)
        names = [f"{t:05d}.png" for t in range(len(indices))]
        for name, frame in zip(names, indices, strict=True):
            image = Image.fromarray(frame, mode="P")
            image.putpalette(palette().tobytes())
            draft = draft_of(folder / name)
            image.save(draft, format="PNG", pnginfo=signature())
            os.replace(draft, folder / name)
        for old in folder.glob("*.png"):
            if old.name not in names and is_signed(old):
                old.unlink()  # a frame of a longer video that was written here before

    def _indices(self, video: PredictedVideo) -> UInt8[np.ndarray, "T H W"]:
        if self.truth:
            labels = labels_of(video, truth=True)
            ignored = labels == (VOID_INDEX if self.ignore_label is None else self.ignore_label)
            largest = int(labels.max(where=~ignored, initial=0))
            indices = np.where(ignored, VOID_INDEX, labels)
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
    """The sub-folders of a folder that hold PNGs, in natural order (v2 before v10)."""
    names = {file.parent.name for file in Path(path).glob("[!.]*/[!.]*") if file.suffix.lower() == ".png"}
    return sorted(names, key=natural_key)


def frame_files(path: str | Path, name: str) -> dict[int, Path]:
    """The PNGs of one video by the number of their frame, ascending.

    Raises:
        UserError: no such video, or names that do not count frames.
    """
    folder = Path(path) / name
    files = sorted(file for file in folder.glob("[!.]*") if file.suffix.lower() == ".png")
    if not files:
        raise UserError(f"{path} has no folder {name} with PNGs, one per frame")
    return numbered(files, str(folder))


def read_davis(path: str | Path, name: str) -> Int64[np.ndarray, "T H W"]:
    """Indices of one video, frames in the order of their numbers.

    Raises:
        UserError: no such video, names that do not count frames, images of different sizes, or with colours in place
            of indices.
    """
    files = list(frame_files(path, name).values())
    frames = [_indices_of(file) for file in files]
    for file, frame in zip(files, frames, strict=True):
        if frame.shape != frames[0].shape:
            raise UserError(f"{file} has the size {frame.shape}, the first frame {frames[0].shape}")
    return np.stack(frames)


def _indices_of(file: Path) -> Int64[np.ndarray, "H W"]:
    try:
        with Image.open(file) as image:
            if image.mode not in LABEL_MODES:
                raise UserError(f"{file} is a {image.mode} image; want one index per pixel (a palette or grey image)")
            # Grey of 2 or 4 bits comes stretched to 0 to 255; labels are what is stored.
            stretched = {"L;2": 85, "L;4": 17}.get(_raw_mode(image), 1)
            return np.asarray(image).astype(np.int64) // stretched
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise UserError(f"{file} is no readable PNG ({error})") from error


def _raw_mode(image: Image.Image) -> str:
    """How the file stores its pixels, in Pillow's words."""
    tiles = getattr(image, "tile", None)
    arguments = tiles[0][3] if tiles else ""
    return str(arguments if isinstance(arguments, str) else arguments[0])


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

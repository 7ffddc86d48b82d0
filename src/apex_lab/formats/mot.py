"""Predictions as MOTChallenge text: boxes for tools that read tracks, and MOTS lines that hold the masks too.

One file `V.txt` per video. Boxes: `frame, id, left, top, width, height, confidence, -1, -1, -1`, all counted from 1 as
the MOTChallenge wants it; the background is left out where it is known. MOTS: `frame id class height width mask`, the
mask in COCO's run-length encoding. Boxes alone cannot be scored here, since every metric needs masks.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Int64, Integer

from apex_lab.base.errors import UserError
from apex_lab.formats.coco import decode, encode
from apex_lab.formats.davis import plain_name
from apex_lab.formats.video import PredictedVideo, with_rest
from apex_lab.scene import ABSENT

MOTS_CLASS = 1
"""There is one class of objects here; MOTS wants a number for it."""


class MotWriter:
    """Writes videos one at a time, each as a file in the folder `path`.

    Args:
        path: the folder.
        masks: MOTS lines in place of boxes.
        truth: write `PredictedVideo.truth` (its label 0 left out) in place of the prediction.
    """

    def __init__(self, path: str | Path, masks: bool = False, truth: bool = False) -> None:
        self.path, self.masks, self.truth = Path(path), masks, truth
        self.path.mkdir(parents=True, exist_ok=True)

    def add(self, video: PredictedVideo) -> None:
        """Writes one video.

        Raises:
            UserError: a name that is no file name.
        """
        labels = video.truth if self.truth else video.identities
        if labels is None:
            raise ValueError(f"video {video.name!r} has no ground truth to write")
        left_out = {0} if self.truth else set(video.background_ids)
        lines = [
            _mask_line(t, name, frame) if self.masks else _box_line(t, name, frame)
            for t, frame in enumerate(labels)
            for name in np.unique(frame).tolist()
            if name not in left_out
        ]
        file = self.path / f"{plain_name(video.name)}.txt"
        draft = file.with_name(f".{file.name}.{os.getpid()}")
        draft.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
        os.replace(draft, file)

    def __enter__(self) -> MotWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is left open."""


def _box_line(frame: int, name: int, labels: Integer[np.ndarray, "H W"]) -> str:
    rows, columns = np.nonzero(labels == name)
    top, left = rows.min(), columns.min()
    height, width = rows.max() - top + 1, columns.max() - left + 1
    return f"{frame + 1},{name + 1},{left + 1},{top + 1},{width},{height},1,-1,-1,-1"


def _mask_line(frame: int, name: int, labels: Integer[np.ndarray, "H W"]) -> str:
    height, width = labels.shape
    (mask,) = encode((labels == name)[None])
    return f"{frame + 1} {name + 1} {MOTS_CLASS} {height} {width} {mask['counts']}"


def read_mots(path: str | Path, name: str, shape: tuple[int, int, int]) -> Int64[np.ndarray, "T H W"]:
    """Identity map of one video from its MOTS lines.

    Pixels of no mask form one more segment over the whole video; see `video.with_rest`.

    Args:
        path: the folder.
        name: of the video.
        shape: (T, H, W) of the ground truth.

    Raises:
        UserError: no such file, a line of another kind (boxes hold no masks), masks that overlap or have another size.
    """
    file = Path(path) / f"{name}.txt"
    if not file.is_file():
        raise UserError(f"there is no file {file} for video {name!r}")

    def place(found: Int64[np.ndarray, "T H W"]) -> None:
        seen = set()
        for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
            here = f"{file}, line {number}"
            frame, identity, mask = _parse(line, here)
            if not 0 <= frame < shape[0]:
                raise UserError(f"{here}: frame {frame + 1} is none of the {shape[0]} of the ground truth")
            if (frame, identity) in seen:
                raise UserError(f"{here}: frame {frame + 1} has the id {identity + 1} more than once")
            seen.add((frame, identity))
            pixels = decode(mask, shape[1:], here)
            if (found[frame][pixels] != ABSENT).any():
                raise UserError(f"{here}: the mask covers pixels of another; masks must not overlap")
            found[frame][pixels] = identity

    return with_rest(place, shape)


def _parse(line: str, where: str) -> tuple[int, int, dict[str, object]]:
    """Frame and identity, counted from 0, and the mask."""
    words = line.split()
    if line.count(",") >= 6:
        raise UserError(f"{where}: MOTChallenge boxes hold no masks and cannot be scored; write MOTS lines")
    try:
        frame, identity, _, height, width = (int(word) for word in words[:5])
        counts = words[5]
    except (ValueError, IndexError) as error:
        raise UserError(f"{where}: want 'frame id class height width mask', got {line[:60]!r}") from error
    if identity < 1 or len(words) != 6:
        raise UserError(f"{where}: want 'frame id class height width mask' with an id from 1, got {line[:60]!r}")
    return frame - 1, identity - 1, {"size": [height, width], "counts": counts}

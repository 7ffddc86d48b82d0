"""Writes predictions as MOTChallenge text: boxes for tools that read tracks, and MOTS lines that hold the masks too.

One file `V.txt` per video V; frames and ids are counted from 1, as the MOTChallenge wants it, and the background is
left out where it is known.

| | prediction | ground truth |
| --- | --- | --- |
| boxes | `frame,id,left,top,width,height,1,-1,-1,-1` | `frame,id,left,top,width,height,1,1,visibility` |
| MOTS | `frame id 2 height width mask` | the same, and class 10 for a region to ignore |

The id of a prediction is its identity + 1, that of a true object its label, as in `python -m sims.p2d export --format
mot`. Classes are those of pedestrians, 1 and 2, since evaluation kits for pedestrians ignore all others. Masks are
in COCO's run-length encoding. Visibility is the share of the object that is seen, 1 where that is not known. A region
to ignore keeps its label as its id where it is above 0; else its id is 10000.

Beside ground truth lie `V/seqinfo.ini` (length and size of V) and `seqmaps/all.txt` (all names), so TrackEval's
`MotChallenge2DBox` and `MOTSChallenge` read it with `GT_LOC_FORMAT='{gt_folder}/{seq}.txt'`, `SKIP_SPLIT_FOL=True`,
`SEQMAP_FILE='<ground truth>/seqmaps/all.txt'` and `TRACKER_SUB_FOLDER=''`.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Float64, Integer

from apex_lab.base.files import write_text
from apex_lab.formats.davis import plain_name
from apex_lab.formats.rle import encode
from apex_lab.formats.video import PredictedVideo, labels_of
from apex_lab.metrics.contingency import BACKGROUND
from apex_lab.metrics.objects import ObjectMetadata

BOX_CLASS, MASK_CLASS, IGNORED_CLASS = 1, 2, 10
"""A pedestrian among boxes, a pedestrian among masks, a region to ignore among masks."""

IGNORED_ID = 10000
"""MOTS's id of regions to ignore."""

FRAME_RATE = 10
"""Nominal: seqinfo.ini has to name one."""


class MotWriter:
    """Writes videos one at a time, each as a file in the folder `path`.

    Args:
        path: the folder.
        masks: MOTS lines in place of boxes.
        truth: write `PredictedVideo.truth` (its label 0 left out) in place of the prediction.
        ignore_label: pixels of this true label are a region to ignore; boxes leave them out.
    """

    def __init__(
        self, path: str | Path, masks: bool = False, truth: bool = False, ignore_label: int | None = None
    ) -> None:
        self.path, self.masks, self.truth, self.ignore_label = Path(path), masks, truth, ignore_label
        self.path.mkdir(parents=True, exist_ok=True)
        self._names: list[str] = []

    def add(self, video: PredictedVideo) -> None:
        """Writes one video.

        Raises:
            UserError: a name that is no file name.
        """
        labels, name = labels_of(video, self.truth), plain_name(video.name)
        left_out = {BACKGROUND} if self.truth else set(video.background_ids)
        if self.truth and not self.masks and self.ignore_label is not None:
            left_out.add(self.ignore_label)
        visible = _visibility(video.objects, len(labels)) if self.truth and not self.masks else {}
        lines = []
        for t, frame in enumerate(labels):
            for label in np.unique(frame).tolist():
                if label in left_out:
                    continue
                if self.masks:
                    lines.append(self._mask_line(t, label, frame))
                else:
                    share = float(visible[label][t]) if label in visible else 1.0
                    lines.append(self._box_line(t, label, frame, share))
        _write(self.path / f"{name}.txt", lines)
        if self.truth:
            (self.path / name).mkdir(exist_ok=True)
            frames, height, width = labels.shape
            about = {"name": name, "imDir": "img1", "frameRate": FRAME_RATE, "seqLength": frames}
            about |= {"imWidth": width, "imHeight": height, "imExt": ".png"}
            _write(
                self.path / name / "seqinfo.ini", ["[Sequence]", *(f"{key}={value}" for key, value in about.items())]
            )
            self._names.append(name)

    def _box_line(self, frame: int, label: int, labels: Integer[np.ndarray, "H W"], visible: float) -> str:
        rows, columns = np.nonzero(labels == label)
        top, left = rows.min(), columns.min()
        height, width = rows.max() - top + 1, columns.max() - left + 1
        end = f"{BOX_CLASS},{visible:.4f}" if self.truth else "-1,-1,-1"
        return f"{frame + 1},{self._id(label)},{left + 1},{top + 1},{width},{height},1,{end}"

    def _mask_line(self, frame: int, label: int, labels: Integer[np.ndarray, "H W"]) -> str:
        height, width = labels.shape
        (mask,) = encode((labels == label)[None])
        kind = IGNORED_CLASS if self.truth and label == self.ignore_label else MASK_CLASS
        return f"{frame + 1} {self._id(label)} {kind} {height} {width} {mask['counts']}"

    def _id(self, label: int) -> int:
        if not self.truth:
            return label + 1
        return label if label > 0 else IGNORED_ID

    def __enter__(self) -> MotWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self.truth:
            (self.path / "seqmaps").mkdir(exist_ok=True)
            _write(self.path / "seqmaps" / "all.txt", ["name", *self._names])


def _visibility(objects: ObjectMetadata | None, frames: int) -> dict[int, Float64[np.ndarray, " T"]]:
    """Label -> visible share per frame, where it is known; 0 where nothing would be seen anyway."""
    if objects is None or objects.occlusion is None or len(objects.occlusion) != frames:
        return {}
    shares = np.clip(1 - np.nan_to_num(np.asarray(objects.occlusion, dtype=np.float64), nan=1.0), 0, 1)
    return {int(label): shares[:, place] for place, label in enumerate(objects.labels)}


def _write(file: Path, lines: list[str]) -> None:
    write_text(file, "".join(f"{line}\n" for line in lines))

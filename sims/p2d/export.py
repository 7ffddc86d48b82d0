"""Export of a P2D folder to common formats: PNGs with COCO-style or MOTChallenge ground truth.

COCO-style, for instance segmentation (`pycocotools`):

```
images/<split>/<video>/<frame>.png         frame 5 digits, from 0
annotations/instances_<split>.json         one image per frame; run-length encoded masks; `video_id`, `track_id`
```

MOTChallenge-style, for box trackers (`TrackEval`, `motmetrics`):

```
P2D-<split>/<video>/img1/<frame>.png    frame 6 digits, from 1
P2D-<split>/<video>/gt/gt.txt           frame, id, left, top, width, height, 1, 1, visibility; all from 1
P2D-<split>/<video>/gt/names.txt        id and class name of the arm and each object in the video
P2D-<split>/<video>/seqinfo.ini
seqmaps/P2D-<split>.txt                 names of the videos
```

A video is named as `video_name` says, <split>_<number>, as in predictions and results of `apex_lab`. The class column
of gt.txt is always 1, because MOTChallenge evaluation ignores all other classes. In both formats, identities are the
ids of the segmentation: 1 the arm, 2 and up the objects.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pycocotools import mask as rle

from recordings.files import no_room
from recordings.layout import array_path
from recordings.progress import progress
from sims.errors import SimError
from sims.p2d.store import Manifest, check
from sims.p2d.trajectory import ARM_ID, FIRST_OBJECT_ID

MARKER = ".p2d_export"
"""A file in folders of unfinished exports; others are never removed."""

FRAME_RATE = 10
"""Nominal: frames are spread evenly over a push, whose duration varies."""


def video_name(split: str, index: int) -> str:
    """What a video is called in exports, predictions and results: its split and its number there, from 0."""
    return f"{split}_{index:05d}"


@dataclass(frozen=True)
class Video:
    """One trajectory; T frames.

    Attributes:
        index: in its split.
        rgb: (T, H, W, 3) uint8.
        segmentation: (T, H, W) uint8.
        names: id -> class name.
        visibility: (T, 1 + O) visible share of the arm and each object, indexed by id - 1.
    """

    index: int
    rgb: np.ndarray
    segmentation: np.ndarray
    names: dict[int, str]
    visibility: np.ndarray


def export(root: Path, out: Path, form: str, splits: Sequence[str], *, shown: bool = True) -> None:
    """Writes the given splits to a new folder, atomically.

    Args:
        root: a finished P2D folder.
        out: must not exist.
        form: "coco" or "mot".
        splits: which splits.
        shown: whether progress is shown on stderr.

    Raises:
        SimError: `out` exists, the data are missing or damaged, or the disk is full.
    """
    manifest = check(root, splits=splits)
    if out.exists():
        raise SimError(f"{out} exists already: choose another folder")
    draft = out.with_name(f".{out.name}.unfinished")
    if os.path.lexists(draft) and not _is_ours(draft):
        raise SimError(f"{draft} is in the way, and no export made it: move it elsewhere")
    shutil.rmtree(draft, ignore_errors=True)
    total = sum(getattr(manifest.settings, split) for split in splits) * manifest.settings.frames
    try:
        draft.mkdir(parents=True)
        (draft / MARKER).touch()
        with progress(f"{form} {out.name}", total, "frames", shown=shown) as advance:
            for split in splits:
                WRITERS[form](draft, split, _videos(root, split, manifest, advance), manifest)
        os.replace(draft, out)
        (out / MARKER).unlink()
    except OSError as error:
        raise no_room(error, error.filename or out) from error
    finally:
        if _is_ours(draft):
            shutil.rmtree(draft, ignore_errors=True)


def _is_ours(draft: Path) -> bool:
    """Whether a folder is of an export that was not finished, even one that was killed as it began."""
    if draft.is_symlink() or not draft.is_dir():
        return False
    return (draft / MARKER).is_file() or not any(draft.iterdir())


def _videos(root: Path, split: str, manifest: Manifest, advance: Callable[[int], None]) -> Iterator[Video]:
    count = getattr(manifest.settings, split)
    names = ("rgb", "segmentation", "classes", "visible_px", "amodal_px")
    mode = "r" if count else None
    arrays = [np.load(array_path(root, split, name), mmap_mode=mode, allow_pickle=False) for name in names]  # type: ignore[arg-type]
    for index in range(count):
        rgb, segmentation, classes, visible, amodal = (np.asarray(array[index]) for array in arrays)
        used = {FIRST_OBJECT_ID + slot: manifest.facts["classes"][c] for slot, c in enumerate(classes) if c >= 0}
        visibility = np.clip(visible / np.maximum(amodal, 1), 0, 1)
        yield Video(index, rgb, segmentation, {ARM_ID: "arm", **used}, visibility)
        advance(len(rgb))


def _coco(out: Path, split: str, videos: Iterator[Video], manifest: Manifest) -> None:
    size, frames = manifest.settings.image_size, manifest.settings.frames
    names = ["arm", *manifest.facts["classes"]]
    category = {name: number for number, name in enumerate(names, start=1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    described: list[dict[str, Any]] = []
    (out / "annotations").mkdir(exist_ok=True)
    for video in videos:
        folder = Path("images", split, video_name(split, video.index))
        (out / folder).mkdir(parents=True)
        described.append({"id": video.index, "name": folder.name, "width": size, "height": size, "length": frames})
        for frame, picture in enumerate(video.rgb):
            path = folder / f"{frame:05d}.png"
            _write_png(out / path, picture)
            image = len(images)
            place = {"video_id": video.index, "frame_id": frame}
            images.append({"id": image, "file_name": path.as_posix(), "width": size, "height": size, **place})
            for identity, name in video.names.items():
                mask = video.segmentation[frame] == identity
                if not mask.any():
                    continue
                code = rle.encode(np.asfortranarray(mask, dtype=np.uint8))
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": image,
                        "video_id": video.index,
                        "track_id": identity,
                        "category_id": category[name],
                        "iscrowd": 0,
                        "area": int(mask.sum()),
                        "bbox": [float(value) for value in rle.toBbox(code)],
                        "segmentation": {"size": list(code["size"]), "counts": code["counts"].decode("ascii")},
                        "visibility": round(float(video.visibility[frame, identity - ARM_ID]), 4),
                    }
                )
    page = {
        "info": {"description": f"P2D (re-creation), split {split}", "version": manifest.content},
        "licenses": [],
        "categories": [{"id": number, "name": name, "supercategory": "object"} for name, number in category.items()],
        "videos": described,
        "images": images,
        "annotations": annotations,
    }
    (out / "annotations" / f"instances_{split}.json").write_text(json.dumps(page), encoding="utf-8")


def _mot(out: Path, split: str, videos: Iterator[Video], manifest: Manifest) -> None:
    size, frames = manifest.settings.image_size, manifest.settings.frames
    benchmark = f"P2D-{split}"
    (out / benchmark).mkdir()
    (out / "seqmaps").mkdir(exist_ok=True)
    sequences = []
    for video in videos:
        name = video_name(split, video.index)
        sequences.append(name)
        folder = out / benchmark / name
        for part in ("img1", "gt"):
            (folder / part).mkdir(parents=True)
        lines = []
        for frame, picture in enumerate(video.rgb):
            _write_png(folder / "img1" / f"{frame + 1:06d}.png", picture)
            for identity in video.names:
                rows, columns = np.nonzero(video.segmentation[frame] == identity)
                if rows.size == 0:
                    continue
                left, top = int(columns.min()) + 1, int(rows.min()) + 1
                wide, high = int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1
                seen = video.visibility[frame, identity - ARM_ID]
                lines.append(f"{frame + 1},{identity},{left},{top},{wide},{high},1,1,{seen:.4f}\n")
        (folder / "gt" / "gt.txt").write_text("".join(lines), encoding="ascii")
        names = "".join(f"{identity} {name}\n" for identity, name in video.names.items())
        (folder / "gt" / "names.txt").write_text(names, encoding="utf-8")
        (folder / "seqinfo.ini").write_text(
            f"[Sequence]\nname={name}\nimDir=img1\nframeRate={FRAME_RATE}\nseqLength={frames}\n"
            f"imWidth={size}\nimHeight={size}\nimExt=.png\n",
            encoding="ascii",
        )
    seqmap = "".join(f"{name}\n" for name in ["name", *sequences])
    (out / "seqmaps" / f"{benchmark}.txt").write_text(seqmap, encoding="ascii")


WRITERS: dict[str, Callable[[Path, str, Iterator[Video], Manifest], None]] = {"coco": _coco, "mot": _mot}


def _write_png(path: Path, rgb: np.ndarray) -> None:
    _, code = cv2.imencode(".png", rgb[..., ::-1])
    path.write_bytes(code.tobytes())  # unlike cv2.imwrite, this raises on a full disk

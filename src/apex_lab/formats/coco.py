"""Predictions and ground truth as COCO has them: what `pycocotools` reads with `COCO(file)` and `loadRes(file)`.

Ground truth: an object with `images`, `annotations` (run-length masks, boxes, areas), `categories` and `videos`. Images
are the frames of all videos in order, their ids counted from 0; `video_id` and `frame_id` say where one belongs, and
`track_id` is the true label. Pixels to be ignored are annotations with `iscrowd` 1. This is also the layout of
`python -m sims.p2d export --format coco`, whose ids are the same where all videos of a split were evaluated.

Predictions: a result list, one entry per mask with `image_id`, `category_id` (there is one category, "object"),
`segmentation`, `score` (1) and `track_id`, the identity over time. The background is left out where it is known;
the reader makes one segment of all pixels without a mask.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Int64, Integer

from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.formats.bounds import check_integer, check_shape
from apex_lab.formats.rle import UNPAINTED, encode, paint
from apex_lab.formats.video import PredictedVideo, labels_of, with_rest
from apex_lab.metrics.contingency import BACKGROUND
from apex_lab.scene import ABSENT

CATEGORY = {"id": 1, "name": "object", "supercategory": "object"}
"""Classes are not predicted here, and COCO compares masks of one category alone."""

Places = Mapping[int, tuple[str, int]]
"""Image id -> name of the video and place of the frame in it, from 0."""


class CocoWriter:
    """Collects videos one at a time; the file appears under its name when all are there (`with` it).

    Args:
        path: the file.
        truth: write `PredictedVideo.truth` with images and annotations in place of a result list.
        ignore_label: pixels of this true label become annotations with `iscrowd` 1.
    """

    def __init__(self, path: str | Path, truth: bool = False, ignore_label: int | None = None) -> None:
        self.path, self.truth, self.ignore_label = Path(path), truth, ignore_label
        self._videos: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []
        self._masks: list[dict[str, Any]] = []

    def add(self, video: PredictedVideo) -> None:
        """Adds one video."""
        labels = labels_of(video, self.truth)
        frames, height, width = labels.shape
        number, size = len(self._videos), {"width": width, "height": height}
        self._videos.append({"id": number, "name": video.name, **size, "length": frames})
        left_out = {BACKGROUND} if self.truth else set(video.background_ids)
        for t, frame in enumerate(labels):
            image = {"id": len(self._images), "file_name": f"{video.name}/{t:05d}.png", **size}
            self._images.append({**image, "video_id": number, "frame_id": t})
            place = {"image_id": image["id"], "video_id": number, "frame_id": t}
            names = [name for name in np.unique(frame).tolist() if name not in left_out]
            for name in names:
                self._masks.append({**place, **self._mask(frame, name)})

    def _mask(self, frame: Integer[np.ndarray, "H W"], name: int) -> dict[str, Any]:
        mask = frame == name
        (code,) = encode(mask[None])
        found = {"category_id": CATEGORY["id"], "track_id": name, "segmentation": code}
        if not self.truth:
            return {**found, "score": 1.0}  # without a box: loadRes would take the box's area for the mask's
        rows, columns = np.nonzero(mask)
        box = (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
        more = {"id": len(self._masks) + 1, "iscrowd": int(name == self.ignore_label), "area": int(mask.sum())}
        return {**more, **found, "bbox": [float(value) for value in box]}

    def __enter__(self) -> CocoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            return
        make_folder(self.path.parent)
        page = {
            "info": {"description": "ground truth, written by apex_lab"},
            "licenses": [],
            "categories": [CATEGORY],
            "videos": self._videos,
            "images": self._images,
            "annotations": self._masks,
        }
        write_text(self.path, json.dumps(page if self.truth else self._masks) + "\n")


def read_results(
    results: Sequence[Any], path: Path, places: Places, shapes: Mapping[str, tuple[int, int, int]]
) -> Iterator[tuple[str, Int64[np.ndarray, "T H W"]]]:
    """Identity maps of the videos in a result list, in the order of `shapes`.

    Pixels of no mask form one more segment over the whole video; see `video.with_rest`.

    Args:
        results: content of the file.
        path: of it, for messages.
        places: of every image of the ground truth.
        shapes: name -> (T, H, W) of every video to read.

    Raises:
        UserError: entries without image, track or mask, of images that the ground truth does not have, or masks of
            another size or that overlap.
    """
    by_video: dict[str, list[tuple[int, int, Any, str]]] = {}
    seen = set()
    for number, entry in enumerate(results):
        where = f"{path}, result {number}"
        image, track, mask = _entry(entry, where)
        if image not in places:
            raise UserError(f"{where}: image {image} is none of the {len(places)} images of the ground truth")
        if (image, track) in seen:
            raise UserError(f"{where}: image {image} has the track_id {track} more than once; give each mask its own")
        seen.add((image, track))
        video, frame = places[image]
        by_video.setdefault(video, []).append((frame, track, mask, where))
    for name, shape in shapes.items():

        def place(found: Int64[np.ndarray, "T H W"], name: str = name) -> None:
            for frame, track, mask, where in by_video.get(name, []):
                paint(found[frame], mask, track, ABSENT, where)

        yield name, with_rest(place, shape)


def videos_with_results(results: Sequence[Any], path: Path, places: Places) -> set[str]:
    """Names of the videos in a result list."""
    images = {_entry(entry, f"{path}, result {number}")[0] for number, entry in enumerate(results)}
    return {places[image][0] for image in images if image in places}


def _entry(entry: Any, where: str, truth: bool = False) -> tuple[int, int, Any]:
    """Image, track and mask of a result or an annotation."""
    if not isinstance(entry, dict):
        raise UserError(f"{where}: want an object with image_id, track_id and segmentation, got {str(entry)[:40]!r}")
    for key in ("image_id", "track_id"):
        value = entry.get(key)
        if type(value) is not int or (value < 0 and not truth):
            raise UserError(
                f"{where}: {key} is {value!r}; want an integer >= 0 (where identities mean nothing over time, number "
                "the masks of each image and set scoring.identities=none)"
            )
        check_integer(value, f"{where}: {key}")
    score = entry.get("score", 1.0)
    if not truth and (type(score) not in (int, float) or not math.isfinite(score)):
        raise UserError(f"{where}: score is {score!r}; want a number, or leave it out")
    if "segmentation" not in entry:
        raise UserError(f"{where}: the key segmentation is missing; boxes hold no masks and cannot be scored")
    return entry["image_id"], entry["track_id"], entry["segmentation"]


class CocoTruth:
    """Ground truth with images, annotations and videos: `CocoWriter(truth=True)` or `python -m sims.p2d export`.

    Args:
        page: content of the file.
        path: of it, for messages.

    Raises:
        UserError: images that do not say to which frame of which video they belong.
    """

    def __init__(self, page: Mapping[str, Any], path: Path) -> None:
        self._path = path
        try:
            names = {video["id"]: str(video["name"]) for video in page["videos"]}
            images = {
                image["id"]: (names[image["video_id"]], int(image["frame_id"]), image["height"], image["width"])
                for image in page["images"]
            }
            annotations = list(page["annotations"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise UserError(
                f"{path} lacks {error}: ground truth in COCO's layout needs videos (id, name), images (id, width, "
                "height, video_id, frame_id) and annotations"
            ) from error
        self.names = list(names.values())
        self._frames: dict[str, list[int]] = {name: [] for name in self.names}
        self._sizes: dict[str, tuple[int, int]] = {}
        for name, frame, height, width in images.values():
            check_shape((height, width), 8, f"{path}, video {name!r}")
            self._frames[name].append(check_integer(frame, f"{path}, video {name!r}: a frame_id"))
            if self._sizes.setdefault(name, (height, width)) != (height, width):
                raise UserError(f"{path}: the images of video {name!r} differ in size; they must be alike")
        for name, frames in self._frames.items():
            if not frames or len(set(frames)) < len(frames) or self.names.count(name) > 1:
                raise UserError(
                    f"{path}: video {name!r} has no image, two of one frame_id, or another video of its name; "
                    "correct the file"
                )
            frames.sort()
        self.places = {number: (name, self._frames[name].index(frame)) for number, (name, frame, *_) in images.items()}
        self._annotations: dict[str, list[tuple[int, int, Any, str]]] = {name: [] for name in self.names}
        self._void: dict[str, int] = {}
        for number, annotation in enumerate(annotations):
            where = f"{path}, annotation {number}"
            image, track, mask = _entry(annotation, where, truth=True)
            if image not in self.places:
                raise UserError(f"{where}: there is no image {image}")
            name, place = self.places[image]
            if annotation.get("iscrowd"):
                self._void.setdefault(name, track)
            elif track <= BACKGROUND:
                raise UserError(f"{where}: the track_id is {track}, 0 is the background; number objects from 1 on")
            self._annotations[name].append((place, track, mask, where))

    def labels(self, name: str) -> Int64[np.ndarray, "T H W"]:
        """True labels of one video: the track ids; pixels of no annotation are background.

        Raises:
            UserError: masks that are damaged, of another size or that overlap.
        """
        shape = (len(self._frames[name]), *self._sizes[name])
        check_shape(shape, 8, f"{self._path}, video {name!r}")
        found = np.full(shape, UNPAINTED, dtype=np.int64)
        for frame, track, mask, where in self._annotations[name]:
            paint(found[frame], mask, track, UNPAINTED, where, "the image")
        return np.where(found == UNPAINTED, BACKGROUND, found)

    def metadata(self, name: str) -> None:
        """Nothing is known."""

    def numbers(self, name: str) -> list[int]:
        """`frame_id` of its images."""
        return self._frames[name]

    def void(self, name: str) -> int | None:
        """A label that this video marks as a region to ignore (`iscrowd`)."""
        return self._void.get(name)

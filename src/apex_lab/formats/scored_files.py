"""Scores files of predictions, made by whatever program, with the code that scores the models of this repository."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from jaxtyping import Int64, Integer

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.formats.bounds import GIGABYTES, at_most
from apex_lab.formats.coco import CocoTruth, Places, read_results, videos_with_results
from apex_lab.formats.davis import frame_files, read_davis, video_names
from apex_lab.formats.frames import check_pairs
from apex_lab.formats.mots import read_mots, text_names
from apex_lab.formats.npz import NpzFile
from apex_lab.formats.truth import NpzTruth, Truth, load_json, open_truth, void_label
from apex_lab.formats.video import check_labels, fit
from apex_lab.formats.weis import read_weis
from apex_lab.metrics import Evaluator, EvaluatorSettings
from apex_lab.metrics.keys import keys
from apex_lab.metrics.objects import ObjectMetadata

FORMAT_VERSION = 1

Format = Literal["npz", "coco", "weis", "davis", "mots"]
"""What can be read."""

Resize = Literal["masks", "truth"]


@dataclass(frozen=True)
class Scored:
    """One video, ready to be scored."""

    name: str
    prediction: Int64[np.ndarray, "T H W"]
    truth: Integer[np.ndarray, "T H W"]
    metadata: ObjectMetadata | None


def score_predictions(
    path: str | Path,
    *,
    format: str | None = None,
    truth: str | Path | None = None,
    split: str = "test",
    partial: bool = False,
    resize: str | None = None,
    settings: EvaluatorSettings | None = None,
    max_gigabytes: float = GIGABYTES,
    track: Callable[[list[str]], Iterable[str]] = iter,
) -> dict[str, Any]:
    """Every metric of a file (or folder) of predictions, per frame, per video and in total.

    Args:
        path: an npz file, a JSON file (COCO's result list, or the layout of Weis et al.), a folder with a folder of
            PNGs per video, or a folder of MOTS text files.
        format: which of these; inferred from the name where missing.
        truth: ground truth, see `truth.open_truth`; an npz file may hold its own.
        split: of a P2D folder of ground truth.
        partial: let ground truth have videos without a prediction.
        resize: what to do with masks of another size than the ground truth: bring soft `masks` to its size
            bilinearly, or the `truth` to theirs by nearest neighbour; None refuses them.
        settings: how to score; rows per frame and events are kept where missing.
        max_gigabytes: bound of one video's arrays and of a file that is read at once, whatever it declares.
        track: wraps the list of video names, for a progress bar.

    Returns:
        as `Evaluator.result`, with `source` (what was read and how) in front and `keys` (meaning, range and direction
        of every number).

    Raises:
        UserError: files that are missing, damaged or malformed; names file, video, frame and value.
    """
    with at_most(max_gigabytes):
        return _scored(Path(path), format, truth, split, partial, resize, settings, track)


def _scored(
    path: Path,
    format: str | None,
    truth: str | Path | None,
    split: str,
    partial: bool,
    resize: str | None,
    settings: EvaluatorSettings | None,
    track: Callable[[list[str]], Iterable[str]],
) -> dict[str, Any]:
    settings = settings or EvaluatorSettings(per_frame=True, events=True)
    format = format or guess_format(path)
    if format not in get_args(Format):
        raise UserError(f"format is {format!r}; choose one of {', '.join(get_args(Format))}")
    if resize not in (None, *get_args(Resize)):
        raise UserError(f"resize is {resize!r}; choose one of {', '.join(get_args(Resize))}, or leave it out")
    if format in ("davis", "mots") and path.is_file():
        raise UserError(f"format = {format} wants a folder, and {path} is a file; leave format out, or give the folder")
    if truth is not None:
        known = _Labels(open_truth(truth, split), str(truth), settings.ignore_label)
    elif format == "npz":
        known = _Labels(NpzTruth(path), str(path), settings.ignore_label)
    else:
        raise UserError(f"{path} holds no ground truth; name it with truth=FILE or truth=FOLDER")
    evaluator = Evaluator(settings)
    for video in _read(path, format, known, partial, resize, track):
        try:
            evaluator.add(video.name, video.prediction, video.truth, video.metadata)
        except ValueError as error:
            raise UserError(f"{path}: {error}") from error
    known.warn()
    source = {"predictions": str(path), "format": format, "truth": str(truth or path), "resize": resize}
    documented = {name: asdict(key) for name, key in keys(settings.public_first_frame).items()}
    return {"format_version": FORMAT_VERSION, "source": source, "keys": documented, **evaluator.result()}


def guess_format(path: Path) -> Format:
    """The format that a file's name or a folder's content speaks for.

    Raises:
        UserError: none.
    """
    if not path.exists():
        raise UserError(f"there is no file or folder {path}")
    if path.is_dir():
        if video_names(path):
            return "davis"
        if text_names(path):
            return "mots"
    elif path.suffix.lower() == ".json":
        content = load_json(path)
        return "weis" if isinstance(content, list) and any(isinstance(entry, list) for entry in content) else "coco"
    elif path.suffix.lower() == ".npz":
        return "npz"
    raise UserError(
        f"{path} is neither .npz nor .json, nor a folder with a folder of PNGs per video or with MOTS .txt files; "
        f"set format to one of {', '.join(get_args(Format))}"
    )


def write_result(result: dict[str, Any], path: str | Path) -> None:
    """Writes a result as JSON, at once; tables as lists of rows, undefined values as null."""
    path = Path(path)
    make_folder(path.parent)
    write_text(path, json.dumps(plain(result), indent=1, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """What JSON can hold: NaN and infinities become None, tables lists of rows, NumPy numbers Python's."""
    if isinstance(value, pd.DataFrame):
        return plain(value.to_dict(orient="records"))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class _Labels:
    """Ground truth, checked, and what in it looks like pixels that nobody has labelled."""

    def __init__(self, truth: Truth, source: str, ignore_label: int | None) -> None:
        self.truth, self.source, self.ignore_label = truth, source, ignore_label
        self.names = truth.names
        self._void: dict[int, list[str]] = {}

    def of(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        labels = self.truth.labels(name)
        check_labels(labels, f"{self.source}, video {name!r}", self.ignore_label)
        if self.ignore_label is None:
            void = void_label(self.truth, name, labels)
            if void is not None and name not in self._void.setdefault(void, []):
                self._void[void].append(name)
        return labels

    def warn(self) -> None:
        """Names labels that were scored as objects and probably are none."""
        for label, names in self._void.items():
            console.warn(
                f"{self.source}: label {label} was scored as an object in {len(names)} videos, first in {names[0]!r}; "
                f"where it marks unlabelled pixels, set scoring.ignore_label={label}"
            )


def _read(
    path: Path,
    format: str,
    truth: _Labels,
    partial: bool,
    resize: str | None,
    track: Callable[[list[str]], Iterable[str]],
) -> Iterator[Scored]:
    if format == "npz":
        yield from _read_npz(path, truth, partial, resize, track)
        return
    if resize == "masks":
        raise UserError(f"resize=masks needs soft masks, and {path} holds none; resize=truth goes the other way")
    if format in ("coco", "weis"):
        yield from _read_json(path, truth, partial, resize, track)
        return
    names = video_names(path) if format == "davis" else text_names(path)
    for name in track(_common(path, names, truth.names, partial)):
        where = f"{path}, video {name!r}"
        numbers = list(frame_files(path, name)) if format == "davis" else None
        check_pairs(numbers, truth.truth.numbers(name), where)
        labels = truth.of(name)
        found = read_davis(path, name) if format == "davis" else read_mots(path, name, _shape(labels))
        yield Scored(name, found, fit(found, labels, resize, where), truth.truth.metadata(name))


def _read_json(
    path: Path, truth: _Labels, partial: bool, resize: str | None, track: Callable[[list[str]], Iterable[str]]
) -> Iterator[Scored]:
    """Run-length masks: COCO's result list, or videos without names in the order of the ground truth."""
    if resize is not None:
        raise UserError(f"resize={resize} does not go with {path}: run-length masks must have the ground truth's size")
    content = load_json(path)
    if not isinstance(content, list):
        raise UserError(
            f"{path} must hold a list: of results (COCO), or of videos with their frames (Weis et al.); images and "
            "annotations are ground truth"
        )
    shapes = {name: _shape(truth.of(name)) for name in truth.names}
    if content and all(isinstance(entry, dict) for entry in content):
        places = _places(truth.truth, shapes)
        told = videos_with_results(content, path, places)
        silent = [name for name in shapes if name not in told]
        if partial:
            shapes = {name: shape for name, shape in shapes.items() if name in told}
        elif silent:
            console.warn(
                f"{path}: {len(silent)} of {len(shapes)} videos have no result, the first is {silent[0]!r}; they are "
                "scored as videos in which nothing was found (partial=true leaves them out)"
            )
        pairs = read_results(content, path, places, shapes)
    else:
        for name in truth.names:
            check_pairs(None, truth.truth.numbers(name), f"{path}, video {name!r}")
        pairs = zip(shapes, read_weis(content, path, list(shapes.values())), strict=True)
    for progressed, (name, found) in zip(track(list(shapes)), pairs, strict=True):
        assert progressed == name
        yield Scored(name, found, truth.of(name), truth.truth.metadata(name))


def _places(truth: Truth, shapes: dict[str, tuple[int, int, int]]) -> Places:
    """Where every image id belongs: as ground truth in COCO's layout says, else the frames of all videos in order."""
    if isinstance(truth, CocoTruth):
        return truth.places
    frames = [(name, t) for name, shape in shapes.items() for t in range(shape[0])]
    return dict(enumerate(frames))


def _read_npz(
    path: Path,
    truth: _Labels,
    partial: bool,
    resize: str | None,
    track: Callable[[list[str]], Iterable[str]],
) -> Iterator[Scored]:
    own = truth.truth if isinstance(truth.truth, NpzTruth) and truth.truth.path == path else None
    file = NpzFile(path, need=("masks", "ids") if own is None else ("gt", "masks", "ids"))
    names = file.names if own else _common(path, file.names, truth.names, partial)
    if own and resize is None:
        for name in names:
            if file.truth_size(name) != file.size(name):
                (a, b), (c, d) = file.size(name), file.truth_size(name)
                raise UserError(
                    f"{file.where(name)}: the masks are {a} x {b}, the ground truth {c} x {d}; set resize to 'masks' "
                    "or 'truth'"
                )
    for name in track(names):
        check_pairs(None, truth.truth.numbers(name), file.where(name))
        labels = truth.of(name)
        size = (labels.shape[1], labels.shape[2]) if resize == "masks" else None
        found = file.identities(name, size)
        yield Scored(name, found, fit(found, labels, resize, file.where(name)), truth.truth.metadata(name))


def _common(path: Path, predicted: list[str], true: list[str], partial: bool) -> list[str]:
    """The videos to score; those that have a prediction must have ground truth, and the reverse unless `partial`."""
    strange = [name for name in predicted if name not in set(true)]
    if strange:
        raise UserError(f"{path}: video {strange[0]!r} has no ground truth, which has {', '.join(true[:3])}, ...")
    missing = [name for name in true if name not in set(predicted)]
    if missing and not partial:
        raise UserError(
            f"{path}: {len(missing)} of the {len(true)} videos of the ground truth have no prediction, the first is "
            f"{missing[0]!r}; set partial=true to score the others alone"
        )
    if not predicted:
        raise UserError(f"{path} holds no prediction")
    return predicted


def _shape(labels: Integer[np.ndarray, "T H W"]) -> tuple[int, int, int]:
    frames, height, width = labels.shape
    return frames, height, width

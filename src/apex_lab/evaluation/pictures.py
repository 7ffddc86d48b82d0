"""Pictures of the best, the median and the worst videos, made when all scores are known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch.utils.data import default_collate

from apex_lab.base import console, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder
from apex_lab.base.signed import is_signed
from apex_lab.base.validation import one_line, sentence
from apex_lab.data.video_set import VideoSet
from apex_lab.inference.predictor import Predictor
from apex_lab.metrics import KEYS
from apex_lab.view import Item, render_all
from apex_lab.view.curves import has_rows, read_curves
from apex_lab.view.item import one_video

PICTURES_BY = "ari_fg"
"""The score that ranks videos for pictures."""


class Chosen(NamedTuple):
    """A video worth a picture: what it stands for, its name, its score."""

    title: str
    video: str
    value: float


def choose(rows: Sequence[Mapping[str, Any]], count: int, key: str = PICTURES_BY) -> list[Chosen]:
    """The best, the worst, and evenly spaced ranks between: 3 are best, median and worst, 1 is the median.

    Args:
        rows: values per video, `video` its name; videos without a value are left out.
        count: how many; all where there are fewer.
        key: what ranks them, one of `apex_lab.metrics.KEYS` with a direction.

    Raises:
        UserError: no video has a value.
    """
    sign = -1.0 if KEYS[key].better == "up" else 1.0
    known = sorted((sign * row[key], row["video"]) for row in rows if not math.isnan(row[key]))
    if not known and rows and count:
        raise UserError(f"pictures_by = '{key}' is undefined for every video of this model: choose another score.")
    last, count = len(known) - 1, min(count, len(known))
    ranks = [last // 2] if count == 1 else [round(i * last / (count - 1)) for i in range(count)]
    titles = {last: "worst", 0: "best"} if count > 1 else {}
    middle = ranks[count // 2] if count % 2 else None
    found = []
    for rank in ranks:
        title = titles.get(rank, "median" if rank == middle else f"rank {rank + 1}")
        found.append(Chosen(title, known[rank][1], sign * known[rank][0]))
    return found


def spread(names: Sequence[str], count: int) -> list[Chosen]:
    """Videos of an unlabelled set, which no score ranks: evenly spaced ones."""
    count = min(count, len(names))
    ranks = [round(i * (len(names) - 1) / max(count - 1, 1)) for i in range(count)]
    return [Chosen("video", names[rank], math.nan) for rank in ranks]


def draw(
    folder: Path,
    chosen: Sequence[Chosen],
    key: str,
    positions: Mapping[str, int],
    predictor: Predictor,
    videos: VideoSet,
    curves: Path | None = None,
) -> list[Path]:
    """Asks the model for the chosen videos once more and draws them; the pictures' paths, the film strip first.

    Pictures of an earlier evaluation in the folder are replaced, other people's stay. A table of curves without a row
    is left out.

    Args:
        folder: where to.
        chosen: the videos; `key` is the score that ranked them, shown in their captions.
        key: one of `apex_lab.metrics.KEYS`.
        positions: video name -> place in the data set.
        predictor: the model.
        videos: the data set.
        curves: the run's table of curves.
    """
    if not chosen:
        return []
    items = []
    for title, name, value in chosen:
        interrupts.check()
        batch = default_collate([videos[positions[name]]])
        scene = one_video(predictor(batch, detail=True), 0)
        caption = f"{title} {name}" if math.isnan(value) else f"{title} {name} ({key} {value:.2f})"
        items.append(Item(caption, batch["video"], scene, 0, batch.get("segmentation")))
    for old in make_folder(folder).glob("components_*.png"):
        if is_signed(old):
            old.unlink()
    return render_all(folder, items, _readable(curves))


def _readable(curves: Path | None) -> Path | None:
    """The table of curves if it can be drawn; a damaged one costs its page alone."""
    if curves is None or not has_rows(curves):
        return None
    try:
        read_curves(curves)
    except UserError as error:
        console.warn(sentence(f"{one_line(error)}; the page of curves is left out"))
        return None
    return curves

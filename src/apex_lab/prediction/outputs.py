"""What is written of a video: overlay, masks, tracks, table.

A long video is written in parts, each closed before the next begins, so that a kill loses one part at most. At the end
they are joined. Masks as PNG are files of their own and need no joining.
"""

from __future__ import annotations

import csv
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from apex_lab.base.signed import signature
from apex_lab.formats.rle import encode
from apex_lab.prediction.objects import Predicted, Seen
from apex_lab.view.annotated import annotated, index_palette
from apex_lab.view.encoder import FAST, Mp4, join

Add = Callable[[Predicted], None]

FASTEST = 240.0
"""Frames per second of an overlay, at most."""

COLUMNS = ("frame", "time", "id", "left", "top", "width", "height", "x", "y", "area", "presence", "mask_index")
"""Of the table, before the appearance vector."""


class Output(ABC):
    """One kind of result.

    Attributes:
        name: of the file, or folder, among the results.
    """

    name: str

    @abstractmethod
    def part(self, folder: Path) -> AbstractContextManager[Add]:
        """Opens a part in a folder; it is whole when the block is left."""

    @abstractmethod
    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        """Joins the parts, one folder each, to the file among the results.

        Args:
            results: their folder.
            parts: in order.
            rate: frames per second, on average; None where a single frame tells none.
        """


class Overlay(Output):
    """overlay.mp4: the video with its objects painted on it, at a constant frame rate, which is the mean one.

    Args:
        size: (H, W) of its frames.
        fps: rate that is expected. That of a video of a variable rate, or of a camera, is known at the end.
    """

    name = "overlay.mp4"

    def __init__(self, size: tuple[int, int], fps: float) -> None:
        self.size, self.fps = size, fps

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        with Mp4(folder / self.name, self.size, self.fps, FAST) as movie:

            def add(predicted: Predicted) -> None:
                names = {o.index: (str(o.id), *o.centre) for o in predicted.objects if o.centre is not None}
                movie.add(annotated(predicted.frame.image, predicted.index, names))

            yield add

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        slower = 1.0 if rate is None else self.fps / min(rate, FASTEST)
        near = abs(slower - 1) < 0.02  # stored times are rounded
        join(results / self.name, [part / self.name for part in parts], 1.0 if near else slower)


class IndexedPngs(Output):
    """masks/000000.png, ...: a palette image per frame, named by its number."""

    name = "masks"

    def __init__(self, results: Path) -> None:
        self.folder = results / self.name

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        self.folder.mkdir(parents=True, exist_ok=True)
        palette = index_palette().tobytes()

        def add(predicted: Predicted) -> None:
            image = Image.fromarray(predicted.index, mode="P")
            image.putpalette(palette)
            image.save(self.path(predicted.number), format="PNG", pnginfo=signature())

        yield add

    def path(self, number: int) -> Path:
        """The file of a frame."""
        return self.folder / f"{number:06d}.png"

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        """They are in their place."""


class Rle(Output):
    """masks.json: a COCO result list, one line per object and frame; `image_id` is the frame, `track_id` the object."""

    name = "masks.json"

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        with open(folder / self.name, "w", encoding="utf-8") as file:

            def add(predicted: Predicted) -> None:
                for seen in _visible(predicted):
                    (code,) = encode((predicted.index == seen.index)[None])
                    entry: dict[str, Any] = {"image_id": predicted.number, "category_id": 1, "track_id": seen.id}
                    entry |= {"segmentation": code, "score": round(seen.presence, 4)}
                    file.write(json.dumps(entry) + "\n")

            yield add

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        with open(results / self.name, "w", encoding="utf-8") as whole:
            whole.write("[")
            separator = "\n"
            for part in parts:
                with open(part / self.name, encoding="utf-8") as lines:
                    for line in lines:
                        whole.write(separator + line.rstrip("\n"))
                        separator = ",\n"
            whole.write("\n]\n")


class Tracks(Output):
    """tracks.txt: MOTChallenge's boxes, `frame,id,left,top,width,height,presence,-1,-1,-1`; all count from 1."""

    name = "tracks.txt"

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        with open(folder / self.name, "w", encoding="utf-8") as file:

            def add(predicted: Predicted) -> None:
                for seen in _visible(predicted):
                    assert seen.box is not None
                    left, top, width, height = seen.box
                    box = f"{left + 1},{top + 1},{width},{height}"
                    file.write(f"{predicted.number + 1},{seen.id},{box},{seen.presence:.4f},-1,-1,-1\n")

            yield add

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        with open(results / self.name, "w", encoding="utf-8") as whole:
            for part in parts:
                with open(part / self.name, encoding="utf-8") as lines:
                    whole.writelines(lines)


class CsvTable(Output):
    """objects.csv: a row per object and frame, with `COLUMNS` and `appearance_0`, ...; empty where it has no pixel."""

    name = "objects.csv"

    def __init__(self, appearance: bool) -> None:
        self.appearance = appearance

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        with open(folder / self.name, "w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            headed = False

            def add(predicted: Predicted) -> None:
                nonlocal headed
                if not headed:
                    length = predicted.appearance.shape[1] if self.appearance else 0
                    rows.writerow([*COLUMNS, *(f"appearance_{i}" for i in range(length))])
                    headed = True
                for seen, vector in zip(predicted.objects, predicted.appearance, strict=True):
                    more = [f"{value:.6g}" for value in vector.tolist()] if self.appearance else []
                    rows.writerow(["" if value is None else value for value in _row(predicted, seen)] + more)

            yield add

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        with open(results / self.name, "w", encoding="utf-8", newline="") as whole:
            for number, part in enumerate(parts):
                with open(part / self.name, encoding="utf-8", newline="") as lines:
                    heading = next(lines)
                    if number == 0:
                        whole.write(heading)
                    whole.writelines(lines)


class ParquetTable(Output):
    """objects.parquet: as `CsvTable`, with the appearance as one list column."""

    name = "objects.parquet"

    def __init__(self, appearance: bool) -> None:
        whole, real = pa.int64(), pa.float64()
        kinds = dict.fromkeys(COLUMNS, whole) | dict.fromkeys(("time", "x", "y", "presence"), real)
        more = [("appearance", pa.list_(pa.float32()))] if appearance else []
        self.appearance, self.schema = appearance, pa.schema([*kinds.items(), *more])

    @contextmanager
    def part(self, folder: Path) -> Iterator[Add]:
        rows: list[dict[str, object]] = []

        def add(predicted: Predicted) -> None:
            for seen, vector in zip(predicted.objects, predicted.appearance, strict=True):
                more = {"appearance": vector} if self.appearance else {}
                rows.append({**dict(zip(COLUMNS, _row(predicted, seen), strict=True)), **more})

        yield add
        pq.write_table(pa.Table.from_pylist(rows, self.schema), folder / self.name)

    def join(self, results: Path, parts: Sequence[Path], rate: float | None) -> None:
        with pq.ParquetWriter(results / self.name, self.schema) as whole:
            for part in parts:
                whole.write_table(pq.read_table(part / self.name, schema=self.schema))


def _visible(predicted: Predicted) -> list[Seen]:
    return [seen for seen in predicted.objects if seen.box is not None]


def _row(predicted: Predicted, seen: Seen) -> list[int | float | None]:
    """Values of `COLUMNS`."""
    box: Sequence[int | None] = seen.box or (None,) * 4
    centre = (None, None) if seen.centre is None else (round(seen.centre[0], 3), round(seen.centre[1], 3))
    time = round(predicted.frame.time, 6)
    return [predicted.number, time, seen.id, *box, *centre, seen.area, round(seen.presence, 4), seen.index]

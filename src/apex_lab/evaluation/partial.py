"""Intermediate results of an evaluation that can be killed at any time: predictions on the disk, a few videos a file.

A file holds the identity of every pixel and little else, as plain arrays; scores, which take a millisecond a video, are
computed from them again on resumption.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Integer

from apex_lab.base.errors import UserError
from apex_lab.base.files import drafts, make_folder, replacing, write_text


@dataclass(frozen=True)
class Predicted:
    """A model's output for one video, as far as scores and exports need it.

    Attributes:
        name: of the video.
        position: its place in the split.
        identities: of every pixel.
        backgrounds: which identities are background.
        share: share of pixels given to objects; NaN for a model without a background.
        present: mean number of objects present per frame.
        terms: loss terms, in nats.
    """

    name: str
    position: int
    identities: Integer[np.ndarray, "T H W"]
    backgrounds: frozenset[int]
    share: float
    present: float
    terms: dict[str, float] = field(default_factory=dict)


MARKER = ".apex_lab_parts"
"""A file in every folder of parts: folders without it are not ours and never touched."""

MARKED = "Parts of an evaluation by apex_lab that was not finished; they are removed when it is.\n"


class Parts:
    """Predictions in a folder, in the order of the split; a part is there wholly or not at all.

    The folder carries `MARKER`. Only files that this class writes are ever removed.

    Args:
        folder: of this evaluation alone: its name holds the key of the evaluation.
        interval: videos per part.
    """

    def __init__(self, folder: Path, interval: int) -> None:
        self.folder, self.interval = folder, interval

    def __iter__(self) -> Iterator[Predicted]:
        """Reads one part after the other.

        Raises:
            UserError: one is damaged.
        """
        if not self._marked():
            return
        for path in self._files():
            try:
                yield from _read(path)
            except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
                raise UserError(
                    f"{path} is damaged ({error}): remove {self.folder} and run the command again."
                ) from error

    def save(self, predictions: Sequence[Predicted]) -> None:
        """Adds a part.

        Raises:
            UserError: the disk is full, the folder cannot be written, or it is somebody else's.
        """
        if not self._marked():
            if any(make_folder(self.folder).iterdir()):
                raise UserError(f"{self.folder} holds files that apex_lab did not write: move them elsewhere.")
            write_text(self.folder / MARKER, MARKED)
        content: dict[str, Any] = {f"identities_{i}": predicted.identities for i, predicted in enumerate(predictions)}
        about = [
            {
                "name": predicted.name,
                "position": predicted.position,
                "backgrounds": sorted(predicted.backgrounds),
                "share": predicted.share,
                "present": predicted.present,
                "terms": predicted.terms,
            }
            for predicted in predictions
        ]
        buffer = io.BytesIO()
        np.savez_compressed(buffer, about=np.array(json.dumps(about)), **content)
        with replacing(self.folder / f"{len(self._files()):06d}.npz") as file:
            file.write(buffer.getvalue())

    def remove(self) -> None:
        """Removes all parts, because the evaluation is over or starts again; a folder that is not ours stays.

        The last part goes first, so that a kill on the way leaves the first ones, from which one can resume.
        """
        if self._marked():
            for path in [*drafts(self.folder), *reversed(self._files())]:
                path.unlink()
            (self.folder / MARKER).unlink()
        with contextlib.suppress(OSError):  # not there, or somebody put a file there
            self.folder.rmdir()

    def _marked(self) -> bool:
        return not self.folder.is_symlink() and (self.folder / MARKER).is_file()

    def _files(self) -> list[Path]:
        return sorted(path for path in self.folder.glob("*.npz") if _PART.fullmatch(path.name))


_PART = re.compile(r"\d{6}\.npz", re.ASCII)


def _read(path: Path) -> Iterator[Predicted]:
    with np.load(path, allow_pickle=False) as content:
        for i, about in enumerate(json.loads(str(content["about"]))):
            yield Predicted(
                name=about["name"],
                position=about["position"],
                identities=content[f"identities_{i}"],
                backgrounds=frozenset(about["backgrounds"]),
                share=about["share"],
                present=about["present"],
                terms=about["terms"],
            )

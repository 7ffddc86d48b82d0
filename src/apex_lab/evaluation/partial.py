"""What is known so far of an evaluation that can be killed at any time: parts on the disk, each a few videos."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Integer

from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, replacing
from apex_lab.metrics import Evaluator, EvaluatorSettings


@dataclass
class Tally:
    """Scores of some videos.

    Attributes:
        evaluator: the scores.
        positions: video's name -> its place in the split, in the order of scoring.
        shares: video's name -> share of its pixels given to objects; NaN for a model that knows no background.
        identities: video's name -> identity of every pixel and which identities are background, where they are wanted
            for an export.
    """

    evaluator: Evaluator
    positions: dict[str, int] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    identities: dict[str, tuple[Integer[np.ndarray, "T H W"], frozenset[int]]] = field(default_factory=dict)

    @staticmethod
    def empty(settings: EvaluatorSettings) -> Tally:
        """No video yet."""
        return Tally(Evaluator(settings))

    def merge(self, other: Tally) -> None:
        """Takes over the videos of another tally, but not their identities, which would need much memory."""
        self.evaluator.merge(other.evaluator)
        self.positions.update(other.positions)
        self.shares.update(other.shares)

    def __len__(self) -> int:
        return len(self.positions)


class Parts:
    """Tallies in a folder, in the order of the split; a part is there wholly or not at all.

    Args:
        folder: of this evaluation alone: its name tells what is evaluated how.
        interval: videos per part.
        identities: keep the identities of every pixel too.
    """

    def __init__(self, folder: Path, interval: int, identities: bool = False) -> None:
        self.folder, self.interval, self.identities = folder, interval, identities

    def __iter__(self) -> Iterator[Tally]:
        """Reads one part after the other.

        Raises:
            UserError: one is damaged.
        """
        for path in self._files():
            try:
                with open(path, "rb") as file:
                    tally = pickle.load(file)
            except (OSError, EOFError, pickle.UnpicklingError, ValueError, AttributeError, ImportError) as error:
                raise UserError(
                    f"{path} is damaged ({error}): remove {self.folder} and run the command again."
                ) from error
            if not isinstance(tally, Tally):
                raise UserError(f"{path} is no part of an evaluation: remove {self.folder} and run the command again.")
            yield tally

    def save(self, tally: Tally) -> None:
        """Adds a part."""
        make_folder(self.folder)
        with replacing(self.folder / f"{len(self._files()):06d}.pickle") as file:
            pickle.dump(tally, file, protocol=pickle.HIGHEST_PROTOCOL)

    def remove(self) -> None:
        """Removes all parts, because the evaluation is over or is to begin anew."""
        if self.folder.exists():
            shutil.rmtree(self.folder)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.pickle"))

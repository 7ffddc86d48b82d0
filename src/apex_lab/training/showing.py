"""What shows runs outside their folders: values, pictures during training, final results."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from lightning.pytorch.loggers import Logger
from PIL import Image
from pydantic import Field

if TYPE_CHECKING:
    from apex_lab.training.loggers import Curves

Videos = Annotated[int, Field(ge=0, le=100)]
Interval = Annotated[int, Field(ge=1)]


class Showing(ABC):
    """A logger of Lightning's that shows pictures too.

    Attributes:
        pictures: how many validation videos are drawn.
        pictures_every: validations between two pictures.
    """

    pictures: int
    pictures_every: int

    @abstractmethod
    def go_on(self, step: int, curves: Curves | None) -> None:
        """Called once before anything is logged.

        Args:
            step: that the run goes on from; 0 at its start.
            curves: what was logged so far; None for a model that does not train.
        """

    @abstractmethod
    def picture(self, name: str, page: Image.Image, step: int) -> None:
        """Shows a picture of a step of training."""

    @abstractmethod
    def results(self, split: str, scored: Mapping[str, Any], pictures: Sequence[Path], step: int) -> None:
        """Shows the final scores and the pictures that were made of them.

        Args:
            split: what was evaluated.
            scored: what metrics.json holds of it.
            pictures: their files.
            step: weight updates made.
        """

    @abstractmethod
    def close(self, failed: bool = False) -> None:
        """Ends its work; everything is on its way then."""


@contextlib.contextmanager
def closing(loggers: list[Logger]) -> Iterator[list[Logger]]:
    """Closes what shows the run with the block, whatever ends it."""
    failed = True
    try:
        yield loggers
        failed = False
    finally:
        for logger in loggers:
            if isinstance(logger, Showing):
                logger.close(failed)

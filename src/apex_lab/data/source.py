"""A data set as the configuration names it: how to get it, and its three splits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from apex_lab.data.video_set import VideoSet


class VideoSource(ABC):
    """Makes or finds the data, then opens them. Building one reads nothing.

    Attributes:
        sets: the splits by name (train, val, test), after `open`.
        workers: processes that load training clips; 0 loads in the training process.
        labelled: whether the videos have labels, so that they can be scored.
    """

    workers: int = 0
    labelled: bool = True
    sets: Mapping[str, VideoSet]

    def refuse_missing(self) -> None:  # noqa: B027 - most data can be made, so nothing is missing
        """Looks whether everything that cannot be made is there; opens no video, so a sweep asks for each of its jobs.

        Raises:
            UserError: it is not.
        """

    @abstractmethod
    def prepare(self) -> None:
        """Makes sure that the data are there and are right; the first time that can take minutes.

        Raises:
            UserError: they are missing and cannot or may not be made, or are damaged.
        """

    @abstractmethod
    def open(self) -> None:
        """Fills `sets`; call after `prepare`."""

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal data; call after `prepare`."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """The entries about the data in a run's record: at least `name`, `fingerprint` and the settings."""

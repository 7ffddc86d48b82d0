"""Data sets of videos: named items, labelled or not, read whole or as clips."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset

from apex_lab.base.errors import UserError
from apex_lab.metrics.objects import ObjectMetadata

MEDIAN_SAMPLE = 1000
"""Frames that a median image is computed from."""

Item = dict[str, Any]
"""`video` uint8 (T, 3, H, W); `segmentation` uint8 (T, H, W), only of labelled sets; `index` int; `name` str."""


@dataclass(frozen=True)
class Clip:
    """Consecutive frames of one video.

    Attributes:
        video: its index in the set.
        start: first frame.
        frames: how many; None: up to the end.
        view: which camera, for sets with several.
    """

    video: int
    start: int = 0
    frames: int | None = None
    view: int = 0


class VideoSet(Dataset[Item], ABC):
    """Videos of one size; `set[i]` is a whole video, `set[Clip(...)]` a part of one."""

    labelled: bool = True
    """Whether items have a `segmentation`."""

    views: int = 1
    """Cameras per video."""

    @abstractmethod
    def __len__(self) -> int:
        """How many videos there are."""

    @abstractmethod
    def length(self, video: int) -> int:
        """How many frames a video has."""

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""

    @abstractmethod
    def name(self, video: int) -> str:
        """Unique among all sets of the data: the key of scores, drawings, exports and evaluation noise."""

    @abstractmethod
    def read(self, clip: Clip) -> Mapping[str, Tensor]:
        """`video` uint8 (T, 3, H, W) and, where labelled, `segmentation` uint8 (T, H, W): 0 is the background."""

    def metadata(self, video: int) -> ObjectMetadata | None:
        """Metadata of the objects; None without any."""
        return None

    def median(self, sample: int | None = MEDIAN_SAMPLE) -> Float[Tensor, "3 H W"]:
        """Per-pixel median image in [0, 1]: the static background.

        Args:
            sample: number of frames, evenly spaced over the set; None: all of them, which takes long.

        Raises:
            UserError: the set is empty.
        """
        lengths = np.cumsum([self.length(video) for video in range(len(self))])
        total = int(lengths[-1]) if len(lengths) else 0
        if total == 0:
            raise UserError("a set without videos has no median image: give data.train at least one video")
        count = total if sample is None else min(sample, total)
        chosen = (np.arange(count) * total) // count
        frames = []
        for position in chosen:
            video = int(np.searchsorted(lengths, position, side="right"))
            start = int(position - (lengths[video - 1] if video else 0))
            frames.append(self.read(Clip(video, start, 1))["video"][0].numpy())
        return torch.from_numpy(median_image(frames))

    def __getitem__(self, which: int | Clip) -> Item:
        clip = which if isinstance(which, Clip) else Clip(which)
        if not -len(self) <= clip.video < len(self):
            raise IndexError(f"video {clip.video} of a set that has {len(self)}")
        clip = Clip(clip.video % len(self), clip.start, clip.frames, clip.view)
        return {**self.read(clip), "index": clip.video, "name": self.name(clip.video)}


def median_image(frames: Sequence[np.ndarray]) -> Float[np.ndarray, "3 H W"]:
    """(3, H, W) uint8 each -> their per-pixel median in [0, 1], a few rows at a time."""
    height, width = frames[0].shape[1:]
    step = max(1, 2**26 // (len(frames) * width * 3))
    rows = [
        np.median(np.stack([frame[:, top : top + step] for frame in frames]), axis=0) for top in range(0, height, step)
    ]
    return np.ascontiguousarray(np.concatenate(rows, axis=1).astype(np.float32) / 255)

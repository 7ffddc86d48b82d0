"""One split of prepared Sketchy videos: clips of one view of one episode, without labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.data.recorded import told
from apex_lab.data.sketchy.recording import KIND, episodes_of
from apex_lab.data.sketchy.split import SPLITS
from apex_lab.data.sketchy.views import all_views
from apex_lab.data.video_set import Clip, VideoSet
from recordings import Reader


class Sketchy(VideoSet):
    """Clips of `frames` timesteps, each of one view of one episode.

    In training a clip may start at every timestep, so that a random clip has a random start. In validation and test
    clips follow each other without overlap from timestep 0 on, and a remainder is dropped. They are in the order of
    their starts, then views, then episodes: the first ones are of as many episodes as possible, in full view.

    Args:
        folder: made by `python -m apex_lab.data.sketchy`.
        split: "train", "val" or "test".
        frames: of a clip.
        stride: timesteps from one frame to the next; 1 is 10 frames per second.
        windows: of each camera, out of `views.WINDOWS`; None: all that are prepared.
        episodes: how many at most, the first by name; None: all.

    Attributes:
        short: how many episodes are too short for a clip, and left out.

    Raises:
        UserError: the folder is missing, unfinished or damaged, or was prepared without a window.
    """

    labelled = False

    def __init__(
        self,
        folder: Path,
        split: str,
        frames: int,
        stride: int = 1,
        windows: Sequence[str] | None = None,
        episodes: int | None = None,
    ) -> None:
        with told():
            self._reader = Reader(folder, KIND, split)
        settings = self._reader.manifest.settings
        prepared = settings["windows"]
        for window in windows or ():
            if window not in prepared:
                has = ", ".join(prepared)
                raise UserError(
                    f"{folder} was prepared without the window {window!r}: choose of {has} in data.windows."
                )
        self.split, self.frames, self.stride = split, frames, stride
        self.views_used = all_views(windows or prepared)
        several = episodes_of(settings)
        self._before = sum(len(several[other]) for other in SPLITS[: SPLITS.index(split)])
        self._episodes = several[split]
        self._first = np.concatenate([[0], np.cumsum([one.timesteps for one in self._episodes])])
        chosen = self._episodes[:episodes]
        span = 1 + (frames - 1) * stride
        step = 1 if split == "train" else frames * stride
        counts = np.array([max(0, (one.timesteps - span) // step + 1) for one in chosen], dtype=np.int64)
        self.short = int((counts == 0).sum())
        self._episode, self._view, self._start = _clips(counts, len(self.views_used), step)

    def __len__(self) -> int:
        return len(self._start)

    def length(self, video: int) -> int:
        """Frames of a clip; all have the same number."""
        return self.frames

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        side = int(self._reader.manifest.settings["image_size"])
        return side, side

    def name(self, video: int) -> str:
        """Number of the episode over all splits, camera and window, first timestep: "ep000012_fl_c3_t040"."""
        number = self._before + int(self._episode[video])
        return f"ep{number:06d}_{self.views_used[self._view[video]].name}_t{int(self._start[video]):03d}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        """Frames of a clip."""
        stop = self.frames if clip.frames is None else clip.start + clip.frames
        if not 0 <= clip.start < stop <= self.frames:
            raise IndexError(f"frames {clip.start} to {stop - 1} of a clip that has {self.frames}")
        first = int(self._first[self._episode[clip.video]] + self._start[clip.video])
        images = self._reader.array(self.views_used[self._view[clip.video]].name)
        part = images[first + clip.start * self.stride : first + (stop - 1) * self.stride + 1 : self.stride]
        return {"video": torch.from_numpy(np.array(part.transpose(0, 3, 1, 2), order="C"))}

    def meta(self, index: int) -> dict[str, Any]:
        """Where a clip comes from: `episode` (its file's name), `camera`, `window`, `timesteps` int64 (T,)."""
        view = self.views_used[self._view[index]]
        timesteps = int(self._start[index]) + self.stride * np.arange(self.frames)
        name = self._episodes[self._episode[index]].name
        return {"episode": name, "camera": view.camera, "window": view.window, "timesteps": timesteps}


def _clips(counts: np.ndarray, views: int, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Episode, view and first timestep of all clips, in the order of starts, then views, then episodes.

    Args:
        counts: (E,) clips of one view of each episode.
        views: how many.
        step: timesteps from one start to the next.
    """
    episode = np.repeat(np.arange(len(counts)), counts)
    start = step * (np.arange(len(episode)) - np.repeat(np.cumsum(counts) - counts, counts))
    episode, start = np.tile(episode, views), np.tile(start, views)
    view = np.repeat(np.arange(views), len(episode) // views)
    order = np.lexsort((episode, view, start))
    return episode[order].astype(np.int32), view[order].astype(np.int8), start[order].astype(np.int32)

"""P2D as a plain torch data set: needs neither Lightning nor Hydra nor the simulator.

```python
from torch.utils.data import DataLoader
from apex_lab.data import P2D

for batch in DataLoader(P2D("data/p2d", "train"), batch_size=4, shuffle=True):
    batch["video"], batch["segmentation"]  # uint8 (B, T, 3, H, W), uint8 (B, T, H, W)
```
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.data.video_set import MEDIAN_SAMPLE, Clip, VideoSet
from apex_lab.metrics.objects import ObjectMetadata, p2d_metadata
from recordings import array_path
from sims.errors import SimError
from sims.p2d.export import video_name as p2d_video_name
from sims.p2d.store import FIELDS, SPLITS, check


class P2D(VideoSet):
    """One split of a finished P2D folder, read through memory maps.

    Items are dicts: `video` uint8 (T, 3, H, W), `segmentation` uint8 (T, H, W) with 0 background, 1 arm, 2 and up
    objects, each the same number through the whole video, `index` and `name`. Everything else that is known about a
    trajectory comes from `meta`.

    Args:
        root: folder made by `python -m sims.p2d`.
        split: "train", "val" or "test".
        frames: length of the videos; None: all frames.
        start: first frame.

    Raises:
        UserError: no such split or frames, or the folder is missing, unfinished, damaged or of another version.
    """

    def __init__(self, root: str | Path, split: str, frames: int | None = None, start: int = 0) -> None:
        if split not in SPLITS:
            raise UserError(f"P2D has no split {split!r}: choose one of {', '.join(SPLITS)}")
        self.root, self.split = Path(root).absolute(), split
        try:
            self.manifest = check(self.root, splits=[split])
        except SimError as error:
            raise UserError(str(error)) from error
        stored = self.manifest.settings.frames
        end = stored if frames is None else start + frames
        if not 0 <= start < end <= stored:
            raise UserError(f"frames {start} to {end - 1} of {self.root} cannot be read: it has 0 to {stored - 1}")
        self.clip = slice(start, end)
        self._arrays: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return int(getattr(self.manifest.settings, self.split))

    def length(self, video: int) -> int:
        """Frames of a video; all have the same number."""
        return self.clip.stop - self.clip.start

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        side = self.manifest.settings.image_size
        return side, side

    def name(self, video: int) -> str:
        """As exports name it."""
        return p2d_video_name(self.split, video)

    def read(self, clip: Clip) -> dict[str, Tensor]:
        """Frames and labels of a clip."""
        start = self.clip.start + clip.start
        stop = self.clip.stop if clip.frames is None else start + clip.frames
        if not self.clip.start <= start < stop <= self.clip.stop:
            raise IndexError(f"frames {clip.start} to {stop - self.clip.start - 1} of {self.length(clip.video)}")
        video = self._array("rgb")[clip.video, start:stop].transpose(0, 3, 1, 2)
        segmentation = self._array("segmentation")[clip.video, start:stop]
        return {
            "video": torch.from_numpy(np.array(video, order="C")),
            "segmentation": torch.from_numpy(np.array(segmentation)),
        }

    def metadata(self, video: int) -> ObjectMetadata:
        """Class, occlusion and contact of every object."""
        return p2d_metadata(self.meta(video))

    def meta(self, index: int) -> dict[str, Any]:
        """All labels of a trajectory besides the segmentation.

        Returns:
            `names`, the class name of each used object slot, and NumPy arrays as described in the folder's README:
            depth, classes, poses, joints, gripper, visible_px, amodal_px, arm_contact, object_contact, aimed, redraws.
        """
        position = self._position(index)
        found: dict[str, Any] = {}
        for name, field in FIELDS.items():
            if name not in ("rgb", "segmentation"):
                part = self._array(name)[position]
                found[name] = np.array(part[self.clip] if "T" in field.dims else part)
        found["names"] = [self.manifest.facts["classes"][number] for number in found["classes"] if number >= 0]
        return found

    @property
    def camera(self) -> dict[str, Any]:
        """The camera: intrinsics 3 x 3, extrinsics 4 x 4 (world to camera), and what they were made of."""
        return dict(self.manifest.facts["camera"])

    def median(self, sample: int | None = MEDIAN_SAMPLE) -> Float[Tensor, "3 H W"]:
        """Per-pixel median image in [0, 1]: the static background.

        Args:
            sample: number of frames, evenly spaced over the split; None: all of them, which takes long.
        """
        total = len(self) * self.length(0)
        if total == 0:
            raise UserError(f"split {self.split} of {self.root} is empty, so it has no median image")
        count = total if sample is None else min(sample, total)
        cache = self.root / f".median_{self.split}_{count}_{self.manifest.content[:8]}.npy"
        with suppress(OSError, ValueError, EOFError):  # not there, or cut off by a power cut: computed again
            return torch.from_numpy(np.load(cache, allow_pickle=False))
        median = super().median(sample).numpy()
        draft = cache.with_name(f"{cache.name}.{os.getpid()}")
        with suppress(OSError):  # where nothing can be written, it is computed every time
            with open(draft, "wb") as file:
                np.save(file, median)
            os.replace(draft, cache)
        return torch.from_numpy(median)

    def _position(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"trajectory {index} of split {self.split}, which has {len(self)}")
        return index % len(self)

    def _array(self, name: str) -> np.ndarray:
        """The memory map of an array, opened at first use in each process."""
        if name not in self._arrays:
            mode = "r" if len(self) else None  # what is empty cannot be mapped
            self._arrays[name] = np.load(array_path(self.root, self.split, name), mmap_mode=mode, allow_pickle=False)  # type: ignore[arg-type]
        return self._arrays[name]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_arrays": {}}

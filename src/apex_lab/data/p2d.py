"""P2D as a plain torch data set: needs neither Lightning nor Hydra nor the simulator.

```python
from torch.utils.data import DataLoader
from apex_lab.data import P2D

for batch in DataLoader(P2D("data/p2d", "train"), batch_size=4, shuffle=True):
    batch["video"], batch["segmentation"]  # uint8 (B, T, 3, H, W), uint8 (B, T, H, W)
```
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from apex_lab.base.errors import UserError
from apex_lab.data.recorded import RecordedSet
from apex_lab.metrics.objects import ObjectMetadata, p2d_metadata
from sims.p2d.export import video_name as p2d_video_name
from sims.p2d.store import FIELDS, KIND, SPLITS


class P2D(RecordedSet):
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
        super().__init__(root, KIND, split, frames, start)

    def name(self, video: int) -> str:
        """As exports name it."""
        return p2d_video_name(self.split, video)

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
                part = self.reader.array(name)[position]
                found[name] = np.array(part[self.clip] if "T" in field.dims else part)
        found["names"] = [self.manifest.facts["classes"][number] for number in found["classes"] if number >= 0]
        return found

    @property
    def camera(self) -> dict[str, Any]:
        """The camera: intrinsics 3 x 3, extrinsics 4 x 4 (world to camera), and what they were made of."""
        return dict(self.manifest.facts["camera"])

    def _position(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"trajectory {index} of split {self.split}, which has {len(self)}")
        return index % len(self)

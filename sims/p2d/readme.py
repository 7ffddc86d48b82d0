"""The README.md in every P2D folder."""

from __future__ import annotations

import numpy as np

from recordings import Manifest
from recordings.layout import FORMAT_VERSION
from recordings.readme import shape_text
from sims.p2d.settings import Settings

MEANINGS = {
    "rgb": "frames",
    "segmentation": "0 background, 1 arm, 2 + o object slot o; from the same render as `rgb`",
    "depth": "metres along the optical axis",
    "classes": "index into `classes` of the manifest; -1 for an unused slot",
    "poses": "objects in the world: x, y, z in metres, quaternion x, y, z, w; NaN for an unused slot",
    "joints": "seven joint angles in radians, two finger positions in metres",
    "gripper": "pose of the gripper, as `poses`",
    "visible_px": "visible pixels of the arm (0) and of object slot o (1 + o)",
    "amodal_px": "pixels each would cover without occlusion, within the image",
    "arm_contact": "the arm touched the object since the frame before",
    "object_contact": "likewise between two objects",
    "aimed": "the line was sampled to meet an object",
    "redraws": "attempts rejected before this one",
}


def readme(manifest: Manifest[Settings]) -> str:
    """Markdown: a description of the data, type, shape and meaning of every array, and how to read them."""
    settings, layout = manifest.settings, manifest.layout
    rows = "\n".join(
        f"| `{name}.npy` | {np.dtype(field.dtype).name} | {shape_text(layout.shape(name))} | {MEANINGS[name]} |"
        for name, field in layout.fields.items()
    )
    splits = "\n".join(f"| {split} | {count} |" for split, count in layout.counts.items())
    return f"""# P2D, the Panda Pushing Dataset (re-creation)

A simulated Panda arm pushes household objects over a table. A re-creation, from the description in the APEX paper
(Wu, Jones, Engelcke, Posner: APEX: Unsupervised, Object-Centric Scene Segmentation and Tracking for Robot
Manipulation), of a data set that was never released.

Format {FORMAT_VERSION}, fingerprint {manifest.fingerprint}, content {manifest.content}, renderer `{settings.renderer}`.
All settings, versions, the camera and a checksum per trajectory are in `manifest.json`.

| split | trajectories (N) |
|---|---|
{splits}

Each split is a folder of plain NumPy arrays, first axis the trajectory:

| file | type | shape | meaning |
|---|---|---|---|
{rows}

```python
import numpy as np

rgb = np.load("{_first(manifest)}/rgb.npy", mmap_mode="r")  # or, as a torch data set:

from apex_lab.data import P2D

item = P2D(".", "{_first(manifest)}")[0]
item["video"], item["segmentation"]  # uint8 (T, 3, H, W), uint8 (T, H, W)
```

`python -m sims.p2d verify .` checks all bytes, `--repair` generates damaged trajectories again; `python -m sims.p2d
card .` writes the data card, `python -m sims.p2d export . --format coco` (or `mot`) exports to a common format.
"""


def _first(manifest: Manifest[Settings]) -> str:
    return next((split for split, count in manifest.layout.counts.items() if count), "train")

"""Statistics of a P2D folder from its label arrays, and the published values they are calibrated to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recordings.layout import array_path
from sims.p2d.store import SPLITS, Manifest
from sims.p2d.trajectory import ARM_ID

MOVED_M = 0.02
"""An object counts as moved if its centre has been this far from its initial position."""

PUBLISHED = {"visible_per_frame": 2.6, "one_segment_msc": 0.28, "one_segment_msc_fg": 0.06}
"""From the paper's tables: scores of models that put everything into one segment (metrics.md section 0)."""


@dataclass(frozen=True)
class Stats:
    """Statistics over all trajectories of some splits; N trajectories, T frames, O object slots.

    Attributes:
        objects: (N,) objects per scene, without the arm.
        classes: (N, O) class index, -1 unused.
        visible: (N, T) number of objects with at least one visible pixel, including the arm.
        area: (N, T, 1 + O) visible share of the image; arm first; NaN where invisible or unused.
        occlusion: (N, T, 1 + O) occluded share of the amodal mask; NaN where the amodal mask is empty.
        cut: (N, T, 1 + O) the visible mask touches the border of the image.
        step_m: (N, T - 1, O) displacement of an object's centre between frames; NaN unused.
        moved_m: (N, O) largest distance of an object from its initial position; NaN unused.
        arm_contact: (N, T, O), object_contact: (N, T, O, O), as stored.
        aimed: (N,), redraws: (N,), as stored.
    """

    objects: np.ndarray
    classes: np.ndarray
    visible: np.ndarray
    area: np.ndarray
    occlusion: np.ndarray
    cut: np.ndarray
    step_m: np.ndarray
    moved_m: np.ndarray
    arm_contact: np.ndarray
    object_contact: np.ndarray
    aimed: np.ndarray
    redraws: np.ndarray

    @property
    def visible_per_frame(self) -> float:
        """Mean number of visible objects per frame, including the arm."""
        return float(self.visible.mean())

    @property
    def one_segment_msc(self) -> float:
        """MSC of a model that assigns the whole image to one segment: mean over frames of 1 / (visible + 1)."""
        return float((1 / (self.visible + 1)).mean())

    @property
    def one_segment_msc_fg(self) -> float:
        """MSC-FG of that model: mean over frames of the mean area share of the visible objects."""
        total = np.nansum(self.area, axis=2)
        return float((total / np.maximum(self.visible, 1)).mean())

    @property
    def touched(self) -> np.ndarray:
        """(N,) the arm touched an object at some time."""
        return np.asarray(self.arm_contact.any(axis=(1, 2)))

    @property
    def pushed(self) -> np.ndarray:
        """(N,) the arm touched an object that moved by `MOVED_M` or more."""
        return (self.arm_contact.any(axis=1) & (np.nan_to_num(self.moved_m) >= MOVED_M)).any(axis=1)

    @property
    def collided(self) -> np.ndarray:
        """(N,) two objects touched each other at some time."""
        return np.asarray(self.object_contact.any(axis=(1, 2, 3)))


def statistics(root: Path, manifest: Manifest, splits: Sequence[str] = SPLITS) -> Stats:
    """Statistics over the union of the given splits."""
    read = {name: [_load(root, split, name) for split in splits] for name in _NEEDED}
    arrays = {name: np.concatenate(parts) for name, parts in read.items()}
    cut = np.concatenate([_cut(_map(root, split), manifest.settings.max_objects) for split in splits])
    size = manifest.settings.image_size
    visible = arrays["visible_px"].astype(float)
    amodal = arrays["amodal_px"].astype(float)
    centre = arrays["poses"][..., :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        occlusion = np.where(amodal > 0, 1 - visible / amodal, np.nan)
    return Stats(
        objects=(arrays["classes"] >= 0).sum(axis=1),
        classes=arrays["classes"],
        visible=(visible > 0).sum(axis=2),
        area=np.where(visible > 0, visible / size**2, np.nan),
        occlusion=occlusion,
        cut=cut & (visible > 0),
        step_m=np.linalg.norm(np.diff(centre, axis=1), axis=3),
        moved_m=np.linalg.norm(centre - centre[:, :1], axis=3).max(axis=1),
        arm_contact=arrays["arm_contact"],
        object_contact=arrays["object_contact"],
        aimed=arrays["aimed"],
        redraws=arrays["redraws"],
    )


_NEEDED = ("classes", "visible_px", "amodal_px", "poses", "arm_contact", "object_contact", "aimed", "redraws")


def _load(root: Path, split: str, name: str) -> np.ndarray:
    return np.load(array_path(root, split, name), allow_pickle=False)


def _map(root: Path, split: str) -> np.ndarray:
    path = array_path(root, split, "segmentation")
    array = np.load(path, mmap_mode="r" if path.stat().st_size > 128 else None, allow_pickle=False)
    return np.asarray(array)


def _cut(segmentation: np.ndarray, slots: int) -> np.ndarray:
    """(N, T, 1 + O): which ids touch the image border in (N, T, H, W) segmentations."""
    sides = (segmentation[:, :, 0], segmentation[:, :, -1], segmentation[..., 0], segmentation[..., -1])
    border = np.concatenate(sides, axis=2)
    return np.stack([(border == ARM_ID + part).any(axis=2) for part in range(slots + 1)], axis=2)

"""How good is what a model found? Segmentation, tracking and what lies beyond the paper (metrics.md).

Everything here reads label maps: predicted identities and true labels, (T, H, W) per video, 0 is the true background.
Nothing here knows a model.
"""

from __future__ import annotations

from apex_lab.metrics.modules import AdjustedRandIndex, SceneMetrics, SegmentationCovering, SegmentationScore
from apex_lab.metrics.scenes import resize_masks, scene_identities
from apex_lab.metrics.segmentation import ari, ari_fg, covering

__all__ = [
    "AdjustedRandIndex",
    "SceneMetrics",
    "SegmentationCovering",
    "SegmentationScore",
    "ari",
    "ari_fg",
    "covering",
    "resize_masks",
    "scene_identities",
]

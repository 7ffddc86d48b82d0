"""How good is what a model found? Segmentation, tracking and what lies beyond the paper (metrics.md).

Everything here reads label maps: predicted identities and true labels, (T, H, W) per video, 0 is the true background.
Nothing here knows a model. Names are imported when they are first used, so that those who only read scores (`KEYS`)
import no PyTorch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from apex_lab.metrics.keys import KEYS

if TYPE_CHECKING:
    from apex_lab.metrics.evaluator import Evaluator
    from apex_lab.metrics.linking import link_frames
    from apex_lab.metrics.modules import AdjustedRandIndex, SceneMetrics, SegmentationCovering, SegmentationScore
    from apex_lab.metrics.objects import ObjectMetadata, by_property, p2d_metadata
    from apex_lab.metrics.scenes import background_identities, resize_masks, scene_identities
    from apex_lab.metrics.segmentation import ari, ari_fg, covering
    from apex_lab.metrics.tracking import TrackingSettings
    from apex_lab.metrics.video_record import EvaluatorSettings

__all__ = [
    "KEYS",
    "AdjustedRandIndex",
    "Evaluator",
    "EvaluatorSettings",
    "ObjectMetadata",
    "SceneMetrics",
    "SegmentationCovering",
    "SegmentationScore",
    "TrackingSettings",
    "ari",
    "ari_fg",
    "background_identities",
    "by_property",
    "covering",
    "link_frames",
    "p2d_metadata",
    "resize_masks",
    "scene_identities",
]

_MODULES = {
    "evaluator": ("Evaluator",),
    "linking": ("link_frames",),
    "modules": ("AdjustedRandIndex", "SceneMetrics", "SegmentationCovering", "SegmentationScore"),
    "objects": ("ObjectMetadata", "by_property", "p2d_metadata"),
    "scenes": ("background_identities", "resize_masks", "scene_identities"),
    "segmentation": ("ari", "ari_fg", "covering"),
    "tracking": ("TrackingSettings",),
    "video_record": ("EvaluatorSettings",),
}
"""Where each name is."""


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

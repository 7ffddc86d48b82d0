"""Data sets of videos: `P2D` as a plain PyTorch data set, and what a run needs of any data set.

Names are imported when they are first used: processes that only prepare data need no PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apex_lab.data.arrangement import ArrangementClips, ArrangementSource
    from apex_lab.data.clips import ClipSampler
    from apex_lab.data.loaders import training_loader, whole_loader
    from apex_lab.data.own_videos.source import OwnVideosSource
    from apex_lab.data.p2d import P2D
    from apex_lab.data.p2d_source import P2DSource
    from apex_lab.data.recorded import RecordedSet, RecordedSource
    from apex_lab.data.sketchy.source import SketchySource
    from apex_lab.data.sketchy.video_set import Sketchy
    from apex_lab.data.source import VideoSource
    from apex_lab.data.sprites.source import Sprites, SpritesSource
    from apex_lab.data.video_set import Clip, Item, VideoSet

_MODULES = {
    "arrangement": ["ArrangementClips", "ArrangementSource"],
    "clips": ["ClipSampler"],
    "loaders": ["training_loader", "whole_loader"],
    "own_videos.source": ["OwnVideosSource"],
    "p2d": ["P2D"],
    "p2d_source": ["P2DSource"],
    "recorded": ["RecordedSet", "RecordedSource"],
    "sketchy.source": ["SketchySource"],
    "sketchy.video_set": ["Sketchy"],
    "source": ["VideoSource"],
    "sprites.source": ["Sprites", "SpritesSource"],
    "video_set": ["Clip", "Item", "VideoSet"],
}

__all__ = [
    "P2D",
    "ArrangementClips",
    "ArrangementSource",
    "Clip",
    "ClipSampler",
    "Item",
    "OwnVideosSource",
    "P2DSource",
    "RecordedSet",
    "RecordedSource",
    "Sketchy",
    "SketchySource",
    "Sprites",
    "SpritesSource",
    "VideoSet",
    "VideoSource",
    "training_loader",
    "whole_loader",
]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"apex_lab.data.{module}"), name)
    raise AttributeError(f"module 'apex_lab.data' has no attribute {name!r}")

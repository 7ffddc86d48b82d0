"""Data sets of videos: `P2D` as a plain PyTorch data set, and what a run needs of any data set."""

from __future__ import annotations

from apex_lab.data.arrangement import ArrangementClips, ArrangementSource
from apex_lab.data.clips import ClipSampler
from apex_lab.data.loaders import training_loader, whole_loader
from apex_lab.data.p2d import P2D
from apex_lab.data.p2d_source import P2DSource
from apex_lab.data.source import VideoSource
from apex_lab.data.sprites import Sprites, SpritesSource
from apex_lab.data.video_set import Clip, Item, VideoSet

__all__ = [
    "P2D",
    "ArrangementClips",
    "ArrangementSource",
    "Clip",
    "ClipSampler",
    "Item",
    "P2DSource",
    "Sprites",
    "SpritesSource",
    "VideoSet",
    "VideoSource",
    "training_loader",
    "whole_loader",
]

"""The arithmetic of configuration files: what a recipe can compute from other keys. Imports no PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf


def _frames(root: DictConfig, key: str) -> int | None:
    """The number at a key; None where there is none. What is wrong with a value is said where values are checked."""
    frames = OmegaConf.select(root, key)
    return frames if isinstance(frames, int) and frames > 0 else None


def per_frame(otherwise: int, *, _root_: DictConfig) -> float:
    """`${per_frame:20}`: 1 / frames of a clip, the weight that makes a mean over time of a sum over a clip's frames.

    Frames are those of `clips.frames` where it is a number; of whole videos, `data.frames`, where it is null or a
    schedule, whose clips have no one length; and `otherwise` where the data set does not tell.
    """
    return 1 / (_frames(_root_, "clips.frames") or _frames(_root_, "data.frames") or otherwise)


def stairs(values: Sequence[int], milestones: Sequence[int], *, _root_: DictConfig) -> dict[str, Any]:
    """`${stairs:[2,4],[100]}`: a staircase of clip lengths, which ends at whole videos where these are shorter."""
    frames = _frames(_root_, "data.frames")
    if frames is not None:
        values = [*(value for value in values if value < frames), frames][: len(values)]
    return {
        "_target_": "apex_lab.training.schedules.Staircase",
        "values": list(values),
        "milestones": list(milestones[: len(values) - 1]),
    }


def register() -> None:
    """Makes these functions known to OmegaConf."""
    for function in (per_frame, stairs):
        OmegaConf.register_new_resolver(function.__name__, function, replace=True)

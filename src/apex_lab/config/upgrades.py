"""Older configurations read as those of today, and the identity of a configuration across versions.

To add a key: give it a default in the schema or the constructor, and the value that it had implicitly before, here in
`ADDED`. Then no fingerprint changes, so no run gets another name and no checkpoint is orphaned. To move or rename keys:
raise `FORMAT` and add a step to `STEPS`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

FORMAT = 2
"""Version of the layout of configurations, run records and checkpoints."""

ADDED: dict[str, Any] = {
    "trainer.cuda_graph": False,
    "trainer.matmul_precision": "highest",
    "init_from": None,
    "model.motion.bounded": False,  # G-SWM
    "model.unused_parameters": False,  # G-SWM
    "model.untracked": "background",  # SCALOR
    "model.schedule": "rprp",  # OP3
    "clips.starts": "random",
    "model.merges": 0,  # APEX, and the five below
    "model.piece_price": 0.0,
    "model.hollow_price": 0.0,
    "model.pixel_features": 0,
    "model.whole_colours": False,
    "model.background.shadow": 1.0,
    "model.encoder.shortcuts": True,  # APEX, and the next one
    "model.glimpses.shortcut": True,
}
"""Keys added since `FORMAT` was raised, with the value that they had before they existed."""

EXCLUDED = (
    "seed",
    "init_from.checkpoint",  # the digest of its weights stays
    "paths",
    "logger",
    "callbacks.progress",
    "data.root",
    "data.stored",
    "data.workers",
    "data.generate",
    "data.sim_workers",
    "data.prepare_workers",
    "data.verify",
    "trainer.accelerator",
    "trainer.devices",
    "trainer.num_nodes",
    "trainer.log_interval",
    "trainer.checkpoint_interval",
    "trainer.max_minutes",
    "clips.on_device",
    "evaluation.pictures",
    "evaluation.batch_size",
    "evaluation.chunk",
)
"""Keys excluded from the fingerprint, because they cannot change a result."""

TARGETS = {
    "apex_lab.data.P2DModule": "apex_lab.data.P2DSource",
    "apex_lab.optimizers.Muon": "apex_lab.training.optimizers.Muon",
    "apex_lab.callbacks.Progress": "apex_lab.training.callbacks.Progress",
    "apex_lab.loggers.Wandb": "apex_lab.training.loggers.Wandb",
    "apex_lab.models.background_subtraction.BackgroundSubtraction": "apex_lab.models.yardsticks.BackgroundSubtraction",
    "apex_lab.models.color_clusters.ColorClusters": "apex_lab.models.yardsticks.ColorClusters",
    "apex_lab.models.one_segment.OneSegment": "apex_lab.models.yardsticks.OneSegment",
    "apex_lab.models.oracle.Oracle": "apex_lab.models.yardsticks.Oracle",
    **{
        f"apex_lab.schedules.{name}": f"apex_lab.training.schedules.{name}"
        for name in ("Constant", "Linear", "Cosine", "Exponential", "Piecewise")
    },
}
"""Classes that have moved: dotted name of format 1 -> of today."""


def upgraded(config: Mapping[str, Any], format: int) -> dict[str, Any]:
    """A resolved configuration of an older format as one of today.

    Args:
        config: plain containers.
        format: its format, 1 to `FORMAT`.
    """
    found = deepcopy(dict(config))
    for version in range(format, FORMAT):
        found = STEPS[version](found)
    return found


def fingerprint(config: Mapping[str, Any]) -> str:
    """Hexadecimal digest of what can change a result in a resolved configuration of today's format."""
    content = deepcopy(dict(config))
    for key in EXCLUDED:
        _remove(content, key)
    if content.get("optimizer") is None:  # nothing is trained
        for key in ("trainer", "clips", "lr_scale"):
            _remove(content, key)
    for key, before in ADDED.items():
        value = _value(content, key)
        if value == before and type(value) is type(before):
            _remove(content, key)
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def _from_1(config: dict[str, Any]) -> dict[str, Any]:
    """Format 1 had the batch among the settings of the data, and other names of modules."""
    config = _renamed(config)
    data = config["data"]
    clips = {"batch_size": data.pop("batch_size", 4), "frames": None}
    evaluation = {**config["evaluation"], "batch_size": data.pop("eval_batch_size", None) or clips["batch_size"]}
    data.pop("seed", None)
    return {**config, "data": data, "clips": clips, "evaluation": evaluation}


STEPS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: _from_1}
"""Format -> what makes a configuration of it one of the next format."""


def _renamed(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {
            key: TARGETS.get(item, item) if key == "_target_" and isinstance(item, str) else _renamed(item)
            for key, item in value.items()
        }
    return [_renamed(item) for item in value] if isinstance(value, list) else value


def _value(content: Mapping[str, Any], key: str) -> Any:
    value: Any = content
    for word in key.split("."):
        if not isinstance(value, Mapping) or word not in value:
            return None
        value = value[word]
    return value


def _remove(content: dict[str, Any], key: str) -> None:
    parent, _, last = key.rpartition(".")
    holder = _value(content, parent) if parent else content
    if isinstance(holder, dict) and last in holder:
        holder.pop(last)
        if not holder and parent:  # a section that came with the key
            _remove(content, parent)

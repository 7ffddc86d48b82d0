"""A model from the `inference` entry of a checkpoint, which holds all that a prediction needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence
from apex_lab.config import components, limits
from apex_lab.scene import SceneModel


def trained_model(inference: Mapping[str, Any]) -> SceneModel:
    """The model with its weights.

    Args:
        inference: `model`, the configuration node that builds it, and `weights`, its state_dict.

    Raises:
        UserError: the node builds no model, or the weights do not fit it.
    """
    components.check(inference["model"], "model")
    with torch.random.fork_rng(devices=[]), limits.bounded(copies=1):
        model = components.build(inference["model"], "model")
    if not isinstance(model, SceneModel):
        raise UserError(f"model._target_ = {inference['model']['_target_']!r} is not an apex_lab.scene.SceneModel.")
    try:
        model.load_state_dict(inference["weights"])
    except RuntimeError as error:
        raise UserError(sentence(f"The weights do not fit their model: {one_line(error)}")) from error
    return model

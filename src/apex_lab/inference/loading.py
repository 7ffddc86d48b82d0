"""A model from the `inference` entry of a checkpoint, which holds all that a prediction needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence, shown
from apex_lab.config import components, limits
from apex_lab.scene import SceneModel


def changed(model: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The node of a trained model with other values of some arguments.

    Args:
        model: the configuration node that builds it.
        changes: argument -> value; only `SceneModel.changeable` ones can be given.

    Raises:
        UserError: an argument is not among those, the model has no such argument, or a value is impossible.
    """
    allowed = getattr(components.target_of(model, "model"), "changeable", ())
    for name, value in changes.items():
        if name not in allowed:
            rest = f"only {', '.join(allowed)} can" if allowed else "nothing of this model can"
            raise UserError(f"model.{name} = {shown(value)} cannot be changed for trained weights: {rest}.")
    found = {**model, **changes}
    components.check(found, "model")
    return found


def trained_model(inference: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> SceneModel:
    """The model with its weights.

    Args:
        inference: `model`, the configuration node that builds it, and `weights`, its state_dict.
        changes: as of `changed`.

    Raises:
        UserError: the node builds no model, the weights do not fit it, or something is changed that cannot be.
    """
    node = changed(inference["model"], changes or {})
    with torch.random.fork_rng(devices=[]), limits.bounded(copies=1):
        model = components.build(node, "model")
    if not isinstance(model, SceneModel):
        raise UserError(f"model._target_ = {inference['model']['_target_']!r} is not an apex_lab.scene.SceneModel.")
    try:
        model.load_state_dict(inference["weights"])
    except RuntimeError as error:
        raise UserError(sentence(f"The weights do not fit their model: {one_line(error)}")) from error
    return model

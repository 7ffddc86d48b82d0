"""Perception of the arrangement task: image -> detections, from any model with a background."""

from __future__ import annotations

import dataclasses
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence
from apex_lab.inference.loading import trained_model
from apex_lab.inference.predictor import Predictor
from apex_lab.scene import ABSENT, Scene, SceneModel, schedule_at
from sims.arrangement import oracle
from sims.arrangement.types import Detection, Perceive, View

Share = Annotated[float, Field(ge=0, le=1)]


class Perception(ABC):
    """What `conf/perception/<name>.yaml` builds. Building one reads nothing."""

    needs_checkpoint: ClassVar[bool] = False
    """Whether it works with the weights of a checkpoint."""

    @abstractmethod
    def ready(self, inference: Mapping[str, Any] | None, device: torch.device) -> Perceive:
        """The function that the controller calls.

        Args:
            inference: entry of a checkpoint; None where none is needed.
            device: where models run.

        Raises:
            UserError: the model cannot do this task.
        """


class Oracle(Perception):
    """The simulator's own labels; what it scores is the controller's own quality."""

    def ready(self, inference: Mapping[str, Any] | None, device: torch.device) -> Perceive:
        return oracle.perceive


@dataclasses.dataclass(frozen=True)
class Trained(Perception):
    """The model of a checkpoint.

    Args:
        min_presence: objects below are absent; their pixels go to the next best mask.
    """

    needs_checkpoint = True

    min_presence: Share = 0.5

    def ready(self, inference: Mapping[str, Any] | None, device: torch.device) -> Perceive:
        assert inference is not None
        schedule = schedule_at(inference["schedule"], device)
        predictor = Predictor(
            trained_model(inference), schedule, device, inference["precision"], seed=inference["seed"]
        )
        return ModelPerception(predictor, self.min_presence)


class Untrained(Perception):
    """A model that has nothing to learn by gradient.

    Args:
        model: to ask.
        min_presence: objects below are absent.
    """

    def __init__(self, model: SceneModel, min_presence: Share = 0.5) -> None:
        if model.needs_training:
            raise ValueError(f"{type(model).__name__} learns: train it and give checkpoint=... in place of perception")
        self.model, self.min_presence = model, min_presence

    def ready(self, inference: Mapping[str, Any] | None, device: torch.device) -> Perceive:
        return ModelPerception(Predictor(self.model, {}, device), self.min_presence)


class ModelPerception:
    """Calls a model on single images and turns its `Scene` into detections.

    An image is a video of one frame, named by its bytes, so that what is perceived in it is a function of the image.
    A detection is a component that is no background, is present, and wins at least one pixel.

    Args:
        predictor: a model that parts objects from background.
        min_presence: objects below are absent.

    Raises:
        UserError: the model has no background component.
    """

    def __init__(self, predictor: Predictor, min_presence: float) -> None:
        self.predictor, self.min_presence = predictor, min_presence
        side = (predictor.model.input_size or (64, 64))[0]
        empty, name = np.zeros((side, side), dtype=np.uint8), type(predictor.model).__name__
        try:
            background = self._scene(np.zeros((side, side, 3), dtype=np.uint8), empty).background
        except ValueError as error:  # such as a model without what it gets from training data
            raise UserError(sentence(f"{name} perceives nothing in an image: {one_line(error)}")) from error
        if not background.any():
            raise UserError(
                f"{name} does not part objects from background, which the arrangement task needs: use APEX, SCALOR, "
                "SPACE, G-SWM or a yardstick."
            )

    def __call__(self, view: View) -> list[Detection]:
        labels = None if view.truth is None else view.truth.segmentation
        return detections(self._scene(view.rgb, labels), self.min_presence)

    def _scene(self, rgb: np.ndarray, labels: np.ndarray | None) -> Scene:
        """(H, W, 3) uint8, and (H, W) labels for a model that reads the ground truth -> scene of one frame."""
        model = self.predictor.model
        batch: dict[str, Any] = {
            "video": _frame(rgb.transpose(2, 0, 1)),
            "name": [hashlib.sha256(rgb.tobytes()).hexdigest()],
        }
        if model.needs_labels:
            if labels is None:
                raise UserError(f"{type(model).__name__} reads the simulator's labels, which this image has not.")
            batch["segmentation"] = _frame(labels)
        return self.predictor(batch)


def _frame(pixels: np.ndarray) -> Tensor:
    """A batch of one video of one frame."""
    return torch.from_numpy(np.ascontiguousarray(pixels))[None, None]


def detections(scene: Scene, min_presence: float) -> list[Detection]:
    """The objects of a scene of one frame.

    Args:
        scene: B = T = 1.
        min_presence: objects below are absent.

    Returns:
        One detection per object that is present and wins a pixel; masks do not overlap. An object whose presence or
        mask is not finite is absent.
    """
    broken = ~scene.masks.isfinite().all(dim=-1).all(dim=-1) | ~scene.presence.isfinite()
    scene = dataclasses.replace(scene, presence=scene.presence.masked_fill(broken, -1.0))
    ids, presence = scene.ids[0, 0].cpu(), scene.presence[0, 0].float().cpu().numpy()
    appearance = scene.appearance[0, 0].float().cpu().numpy()
    winner = scene.segmentation(min_presence)[0, 0].cpu()
    found = []
    for k in (~scene.background).nonzero().flatten().tolist():
        mask = (winner == ids[k]).numpy()
        if ids[k] != ABSENT and presence[k] >= min_presence and mask.any():
            found.append(Detection(mask, float(presence[k]), appearance[k]))
    return found

"""`oracle`: ground truth in, all ones and hundreds out; a test of the evaluation itself."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Float, Integer
from pydantic import Field
from torch import Tensor

from apex_lab.models.yardsticks.regions import hard_scene, one_hot
from apex_lab.scene import ABSENT, Context, Scene, SceneModel


class Oracle(SceneModel):
    """Returns the labels as a scene: component k is the label k, its identity is k, label 0 is the background.

    Each component shows the video itself, so the reconstruction is exact. `appearance` is the label as a one-hot
    vector: the distance of two objects is 0 if they carry the same label and sqrt(2) otherwise.

    Args:
        max_label: largest label that may occur (P2D: 1 is the arm, objects count from 2); K = max_label + 1.
    """

    needs_training = False
    needs_labels = True

    def __init__(self, max_label: Annotated[int, Field(ge=1, le=255)] = 15) -> None:
        super().__init__()
        self.components = max_label + 1

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Refused: there is nothing to be known from the video alone.

        Raises:
            TypeError: always; call `from_labels`.
        """
        raise TypeError("Oracle reads the ground truth: call from_labels(video, segmentation) in place of forward")

    def from_labels(
        self,
        video: Float[Tensor, "B T 3 H W"],
        segmentation: Integer[Tensor, "B T H W"],
        context: Context | None = None,
    ) -> Scene:
        """RGB video in [0, 1] and its labels -> the perfect scene.

        An object has an identity in the frames in which it has a pixel.

        Raises:
            ValueError: a label is negative or above `max_label`.
        """
        labels = segmentation.long()
        low, high = int(labels.min()), int(labels.max())
        if low < 0 or high >= self.components:
            raise ValueError(
                f"segmentation has labels from {low} to {high}, but the oracle knows 0 to {self.components - 1}: "
                f"set model.max_label={max(high, 1)}"
                if low >= 0
                else f"segmentation has the label {low}: labels count from 0, the background"
            )
        masks = one_hot(labels, self.components)
        visible = masks.flatten(3).any(dim=3)
        visible[..., 0] = True  # the background keeps its identity when it is hidden
        ids = torch.arange(self.components, device=video.device).where(visible, ABSENT)
        appearance = torch.eye(self.components, device=video.device, dtype=video.dtype).expand(*ids.shape, -1)
        means = video[:, :, None].expand(*masks.shape[:3], *video.shape[2:])
        scene = hard_scene(labels, masks, ids, appearance, means)
        return scene if context is not None and context.detail else dataclasses.replace(scene, means=None)

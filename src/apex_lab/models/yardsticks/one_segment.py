"""`one_segment`: what a collapsed model scores, a test of the evaluation itself.

In a frame with n visible objects its unscaled covering is exactly 1 / (n + 1) and its ARI is 0 (metrics.md section 0).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.models.yardsticks.regions import scene_of_regions
from apex_lab.scene import Context, Scene, SceneModel


class OneSegment(SceneModel):
    """Everything is background, painted in the frame's mean colour. K = 1."""

    needs_training = False

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """RGB video in [0, 1]; `context` has no influence."""
        batch, frames, _, height, width = video.shape
        labels = torch.zeros(batch, frames, height, width, dtype=torch.long, device=video.device)
        return scene_of_regions(video, labels, components=1, context=context)

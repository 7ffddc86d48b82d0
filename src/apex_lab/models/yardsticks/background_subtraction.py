"""`background_subtraction`: per-pixel median of the training set plus connected components."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from apex_lab.models.yardsticks.regions import scene_of_regions
from apex_lab.scene import Context, Scene, SceneModel, Statistics


class BackgroundSubtraction(SceneModel):
    """A region that differs from the median image is an object. For a camera that stands still.

    1. A pixel is foreground where its RGB distance to the median image exceeds `threshold`. Shadows are no objects:
       the distance is taken to the nearest shade of the median colour, from `shadow` times that colour to the colour
       itself.
    2. The foreground is cleaned by an opening with a disc of `radius` pixels. There is no closing: it would fill the
       gap between the arm and what it pushes.
    3. Its connected regions (8 neighbours) of at least `min_area` are the objects, the `max_objects` largest of them.
    4. Regions of consecutive frames are linked (`apex_lab.models.yardsticks.linking.link`).

    The reconstruction is the median image with every object in its mean colour. The median image is a buffer, so
    checkpoints carry it. Defaults were chosen by the four segmentation scores of 32 training videos of P2D: labels
    chose them.

    Args:
        image_size: side of the (square) images, in pixels.
        threshold: Euclidean distance in RGB, each channel in [0, 1].
        shadow: darkest shadow as a share of the median colour; 1 takes shadows for objects.
        radius: of the disc, in pixels; 0 for no opening.
        min_area: smallest object as a share of the image.
        max_objects: components beside the background, K = max_objects + 1.
    """

    needs_training = False
    median: Tensor

    def __init__(
        self,
        image_size: Annotated[int, Field(ge=1)] = 128,
        threshold: Annotated[float, Field(gt=0)] = 0.08,
        shadow: Annotated[float, Field(ge=0, le=1)] = 0.4,
        radius: Annotated[int, Field(ge=0)] = 1,
        min_area: Annotated[float, Field(ge=0, lt=1)] = 0.002,
        max_objects: Annotated[int, Field(ge=1, le=63)] = 10,
    ) -> None:
        super().__init__()
        self.threshold = threshold
        self.shadow = shadow
        self.radius = radius
        self.min_area = min_area
        self.max_objects = max_objects
        self.input_size = (image_size, image_size)
        self.register_buffer("median", torch.full((3, image_size, image_size), float("nan")))

    def initialise(self, statistics: Statistics) -> None:
        """Takes the training set's per-pixel median, RGB in [0, 1].

        Raises:
            ValueError: the image has another size than `image_size`.
        """
        median = statistics.median
        if median.shape != self.median.shape:
            raise ValueError(
                f"median has the shape {tuple(median.shape)}, expected {tuple(self.median.shape)}: "
                f"set model.image_size={median.shape[-1]}"
            )
        self.median.copy_(median)

    @torch.no_grad()
    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """RGB video in [0, 1]; `context` has no influence. Works on the CPU, wherever the video lies.

        Raises:
            ValueError: frames of another size than `image_size`, or no median image yet.
        """
        if video.shape[2:] != self.median.shape:
            raise ValueError(
                f"video has frames of the shape {tuple(video.shape[2:])}, expected {tuple(self.median.shape)}: "
                f"set model.image_size={video.shape[-1]}"
            )
        if self.median.isnan().any():
            raise ValueError("BackgroundSubtraction has no median image yet: call initialise(statistics) first")
        median = self.median.to(video)
        # the shade a · median nearest to a colour x: a = <x, median> / <median, median>, held within its limits
        shade = (video * median).sum(dim=2) / median.square().sum(dim=0).clamp(min=1e-6)
        nearest = shade.clamp(self.shadow, 1)[:, :, None] * median
        foreground = (video - nearest).square().sum(dim=2).sqrt() > self.threshold
        frames = foreground.flatten(0, 1).cpu().numpy().astype(np.uint8)
        labels = torch.from_numpy(np.stack([self._components(frame) for frame in frames]))
        return scene_of_regions(
            video,
            labels.unflatten(0, video.shape[:2]).to(video.device),
            self.max_objects + 1,
            background=median,
            context=context,
        )

    def _components(self, foreground: np.ndarray) -> Int[np.ndarray, "H W"]:
        """Foreground of one frame, uint8 of 0 and 1 -> component of every pixel, objects from the largest down."""
        if self.radius > 0:
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * self.radius + 1, 2 * self.radius + 1))
            foreground = cv2.morphologyEx(foreground, cv2.MORPH_OPEN, disc)
        _, numbers, stats, _ = cv2.connectedComponentsWithStats(foreground, connectivity=8)
        areas = stats[:, cv2.CC_STAT_AREA].copy()
        areas[0] = 0  # number 0 is what is not foreground
        order = np.argsort(-areas, kind="stable")
        keep = order[(areas[order] > 0) & (areas[order] >= self.min_area * foreground.size)][: self.max_objects]
        component = np.zeros(len(areas), dtype=np.int64)
        component[keep] = np.arange(1, len(keep) + 1)
        return component[numbers]

"""`color_clusters`: colour k-means plus connected components, the floor that needs no learning.

Legend: R regions in a frame, a region being a connected set of pixels of one colour cluster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor

from apex_lab.models.yardsticks.regions import scene_of_regions
from apex_lab.scene import Context, Scene, SceneModel

SAMPLES = 20_000
"""Pixels of a video that the clusters are fitted to; all pixels are then assigned."""

SAME_COLOR = 1.0
"""Distance below which two cluster centres are one: about the smallest difference in CIELAB that an eye sees."""


@dataclass(frozen=True)
class _Frame:
    """Connected regions of one frame: number of each pixel's region, and properties of each region."""

    region: Int[np.ndarray, "H W"]
    cluster: Int[np.ndarray, " R"]
    area: Int[np.ndarray, " R"]
    border: Bool[np.ndarray, " R"]


class ColorClusters(SceneModel):
    """Segments by colour alone.

    1. The colours of a video are clustered by k-means, once for all of its frames. Colours are compared in CIELAB with
       their lightness weighted by `lightness`, because shading and shadows change lightness more than hue.
    2. In each frame, the connected pixels of one cluster (8 neighbours) make a region.
    3. The background is the largest region that touches the border, of the one cluster whose largest such regions are
       largest over the whole video (so that it does not jump between table and floor from frame to frame).
    4. Regions of less than `min_area`, and all but the `max_objects` largest, are dissolved: their pixels go to the
       nearest region that stays.
    5. Regions of consecutive frames are linked (`apex_lab.models.yardsticks.linking.link`).

    A video's result depends on the video alone, and is the same at every call. Defaults were chosen by the four
    segmentation scores of 32 training videos of P2D: labels chose them.

    Args:
        colors: number of clusters, k.
        lightness: weight of CIELAB's L* relative to a* and b*; 1 for the plain distance.
        min_area: smallest region as a share of the image.
        max_objects: components beside the background, K = max_objects + 1.
        seed: of the pixel sample and of the k-means++ initialisation.
    """

    needs_training = False
    streams = False  # the colours of a whole video are clustered at once

    def __init__(
        self,
        colors: Annotated[int, Field(ge=2, le=64)] = 3,
        lightness: Annotated[float, Field(gt=0, le=1)] = 0.3,
        min_area: Annotated[float, Field(ge=0, lt=1)] = 0.005,
        max_objects: Annotated[int, Field(ge=1, le=63)] = 10,
        seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        super().__init__()
        self.colors = colors
        self.lightness = lightness
        self.min_area = min_area
        self.max_objects = max_objects
        self.seed = seed

    @torch.no_grad()
    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """RGB video in [0, 1]; `context` has no influence. Works on the CPU, wherever the video lies."""
        pixels = np.ascontiguousarray(video.permute(0, 1, 3, 4, 2).cpu().float().numpy())
        labels = torch.from_numpy(np.stack([self._segment(frames) for frames in pixels]))
        return scene_of_regions(video, labels.to(video.device), self.max_objects + 1, context=context)

    def _segment(self, frames: Float[np.ndarray, "T H W 3"]) -> Int[np.ndarray, "T H W"]:
        """One RGB video -> component of every pixel, 0 the background, objects from the largest down."""
        clusters = cluster_colors(frames, self.colors, self.lightness, self.seed)
        regions = [_regions(frame, self.colors) for frame in clusters]
        border_area = np.zeros(self.colors)
        for found in regions:
            largest = np.zeros(self.colors)
            np.maximum.at(largest, found.cluster, found.area * found.border)
            border_area += largest
        return np.stack([self._components(found, int(border_area.argmax())) for found in regions])

    def _components(self, found: _Frame, background_cluster: int) -> Int[np.ndarray, "H W"]:
        """Regions of one frame -> component of every pixel."""
        rank = found.area * found.border * (found.cluster == background_cluster)
        if not rank.any():  # that cluster is hidden in this frame
            rank = found.area * found.border
        background = rank.argmax()
        order = np.argsort(-found.area, kind="stable")
        keep = order[(found.area[order] >= self.min_area * found.region.size) & (order != background)]
        component = np.full(len(found.area), -1)
        component[background] = 0
        component[keep[: self.max_objects]] = np.arange(1, len(keep[: self.max_objects]) + 1)
        return _dissolve(component[found.region])


def cluster_colors(
    frames: Float[np.ndarray, "T H W 3"], colors: int, lightness: float, seed: int
) -> Int[np.ndarray, "T H W"]:
    """k-means over the colours of one RGB video -> cluster of every pixel, 0 .. `colors` - 1.

    Equal colours are always in the same cluster; of fewer different colours than `colors` each gets one of its own.
    """
    lab = cv2.cvtColor(frames.reshape(-1, frames.shape[2], 3), cv2.COLOR_RGB2LAB).reshape(-1, 3)
    lab *= np.array([lightness, 1, 1], dtype=lab.dtype)
    sample = lab
    if len(lab) > SAMPLES:
        sample = lab[np.random.default_rng(seed).choice(len(lab), SAMPLES, replace=False)]
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 0.1)
    _, _, centers = cv2.kmeans(sample, min(colors, len(sample)), None, stop, 2, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
    # Of fewer different colours than clusters, k-means makes several centres for one colour.
    repeats = [(np.linalg.norm(centers[:i] - centers[i], axis=1) < SAME_COLOR).any() for i in range(len(centers))]
    centers = centers[~np.array(repeats)]
    # argmin |x - c|^2 = argmin (|c|^2 - 2 x c)
    return ((centers**2).sum(axis=1) - 2 * lab @ centers.T).argmin(axis=1).reshape(frames.shape[:3])


def _regions(clusters: Int[np.ndarray, "H W"], colors: int) -> _Frame:
    """Connected regions of equal cluster, 8 neighbours."""
    height, width = clusters.shape
    region = np.zeros(clusters.shape, dtype=np.int64)
    owners, found = [], []
    offset = 0
    for cluster in range(colors):
        inside = clusters == cluster
        count, numbers, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=8)
        region[inside] = numbers[inside] + (offset - 1)
        owners.append(np.full(count - 1, cluster))
        found.append(stats[1:])  # number 0 is what is outside
        offset += count - 1
    left, top, w, h, area = np.concatenate(found).T
    border = (left == 0) | (top == 0) | (left + w == width) | (top + h == height)
    return _Frame(region, np.concatenate(owners), area, border)


def _dissolve(component: Int[np.ndarray, "H W"]) -> Int[np.ndarray, "H W"]:
    """Gives pixels marked -1 to the nearest component; at least one pixel is not marked."""
    loose = component < 0
    _, nearest = cv2.distanceTransformWithLabels(
        loose.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, dtype=component.dtype)
    owner[nearest[~loose]] = component[~loose]
    return owner[nearest]

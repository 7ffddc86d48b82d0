"""One video of a batch, a model's output for it, and the truth: the input of every drawing."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Integer, UInt8
from torch import Tensor

from apex_lab.scene import Scene
from apex_lab.view.canvas import enlarge
from apex_lab.view.colors import colorize, overlay, rgb8


class Item(NamedTuple):
    """A video to be drawn.

    Attributes:
        name: caption and part of file names, such as "video 12".
        video: the batch, uint8 or float in [0, 1].
        scene: a model's output for that batch.
        b: which video of the batch is drawn.
        segmentation: ground truth, 0 is background; None if there is none (the row is left out).
    """

    name: str
    video: UInt8[Tensor, "B T 3 H W"] | Float[Tensor, "B T 3 H W"]
    scene: Scene
    b: int
    segmentation: Integer[Tensor, "B T H W"] | None = None


class Clip:
    """An `Item` as arrays on the CPU, ready to be painted.

    Attributes:
        name: as `Item.name`.
        frames: (T, H, W, 3) uint8, the input.
        reconstruction: (T, h, w, 3) uint8; the model's own resolution may differ from the video's.
        segmentation: (T, h, w) int, identity of the winning component (`Scene.segmentation`).
        truth: (T, H, W) int, or None.
        background: identities that are background.
        scene: that video's scene, B = 1, on the CPU.
    """

    def __init__(self, item: Item) -> None:
        """Cuts one video out of the batch.

        Raises:
            ValueError: video, scene and ground truth do not fit each other.
        """
        name, video, scene, b, truth = item
        _check(video, scene, b, truth)
        self.name = name
        self.frames = _picture(video[b])
        self.scene = one_video(scene, b)
        self.reconstruction = _picture(self.scene.reconstruction[0])
        self.segmentation: np.ndarray = self.scene.segmentation()[0].numpy()
        self.truth: np.ndarray | None = None if truth is None else truth[b].cpu().long().numpy()
        self.background = {int(i) for i in self.scene.ids[:, :, self.scene.background].unique() if i >= 0}

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the video."""
        return self.frames.shape[1], self.frames.shape[2]

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """Names of what can be shown side by side."""
        names = ("input", "reconstruction", "masks", "masks on input", "ground truth")
        return names if self.truth is not None else names[:-1]

    def panel(self, row: str, t: int, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
        """One of `rows` at frame t, as (height, width) = `size` pixels."""
        if row == "input":
            return enlarge(self.frames[t], size)
        if row == "reconstruction":
            return enlarge(self.reconstruction[t], size)
        if row == "masks":
            return enlarge(colorize(self.segmentation[t], self.background), size)
        if row == "masks on input":
            return overlay(enlarge(self.frames[t], size), enlarge(self.segmentation[t], size), self.background)
        if row == "ground truth" and self.truth is not None:
            return enlarge(colorize(self.truth[t], {0}), size)
        raise ValueError(f"row is {row!r}, expected one of {', '.join(self.rows)}")


def one_video(scene: Scene, b: int) -> Scene:
    """The scene of video `b` alone (B = 1), on the CPU, in float32, without loss terms."""

    def cut(tensor: Tensor) -> Tensor:
        tensor = tensor[b : b + 1].detach().cpu().clone()  # a view would keep the whole batch alive
        return tensor.float() if tensor.is_floating_point() else tensor

    return dataclasses.replace(
        scene,
        masks=cut(scene.masks),
        background=scene.background.detach().cpu(),
        ids=cut(scene.ids),
        presence=cut(scene.presence),
        appearance=cut(scene.appearance),
        reconstruction=cut(scene.reconstruction),
        windows=None if scene.windows is None else cut(scene.windows),
        means=None if scene.means is None else cut(scene.means),
        terms={},
        diagnostics={},
    )


def _picture(frames: Tensor) -> UInt8[np.ndarray, "T H W 3"]:
    """(T, 3, H, W), uint8 or float in [0, 1], to pixels."""
    frames = frames.detach().cpu().permute(0, 2, 3, 1)
    if frames.dtype == torch.uint8:
        return frames.contiguous().numpy()
    return rgb8(frames.float().numpy())


def _check(video: Tensor, scene: Scene, b: int, truth: Tensor | None) -> None:
    if video.ndim != 5 or video.shape[2] != 3 or video.shape[1] == 0:
        raise ValueError(f"video has the shape {tuple(video.shape)}, expected (B, T, 3, H, W) with T > 0")
    if not (video.dtype == torch.uint8 or video.is_floating_point()):
        raise ValueError(f"video is {video.dtype}, expected uint8 or floats in [0, 1]")
    if not 0 <= b < len(video):
        raise ValueError(f"b is {b}, expected 0 to {len(video) - 1}: there are {len(video)} videos in the batch")
    if scene.masks.shape[:2] != video.shape[:2]:
        raise ValueError(f"scene is of (B, T) = {tuple(scene.masks.shape[:2])}, the video of {tuple(video.shape[:2])}")
    if truth is not None and truth.shape != video.shape[:2] + video.shape[3:]:
        expected = tuple(video.shape[:2] + video.shape[3:])
        raise ValueError(f"segmentation has the shape {tuple(truth.shape)}, expected {expected}")

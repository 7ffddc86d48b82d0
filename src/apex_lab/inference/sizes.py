"""Videos to a model's input size, and its output back to the video's."""

from __future__ import annotations

import dataclasses

import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from apex_lab.metrics.scenes import resize_masks
from apex_lab.scene import Scene

Size = tuple[int, int]


def as_float(video: UInt8[Tensor, "*batch 3 H W"]) -> Float[Tensor, "*batch 3 H W"]:
    """RGB in [0, 1] from bytes, on the device where the bytes are."""
    return video.float() / 255.0


def fitted(video: Float[Tensor, "B T 3 H W"], size: Size | None) -> Float[Tensor, "B T 3 H2 W2"]:
    """The video at a model's input size, antialiased; as it is where the sizes agree or any size will do."""
    if size is None or tuple(video.shape[-2:]) == tuple(size):
        return video
    return resized_images(video, size)


def fitted_back(scene: Scene, size: Size) -> Scene:
    """A scene at the size of the video: masks, reconstruction and means; masks still sum to 1."""
    if tuple(scene.masks.shape[-2:]) == tuple(size):
        return scene
    return dataclasses.replace(
        scene,
        masks=resize_masks(scene.masks, size),
        reconstruction=resized_images(scene.reconstruction, size),
        means=None if scene.means is None else resized_images(scene.means, size),
    )


def resized_images(images: Float[Tensor, "*batch 3 H W"], size: Size) -> Float[Tensor, "*batch 3 H2 W2"]:
    """Images in [0, 1] in another size: bilinear, antialiased."""
    flat = images.float().reshape(-1, *images.shape[-3:])
    found = F.interpolate(flat, size=size, mode="bilinear", align_corners=False, antialias=True)
    return found.clamp(0, 1).reshape(*images.shape[:-2], *size)

"""From a `Scene` to what the metrics read: one identity per pixel."""

from __future__ import annotations

import dataclasses

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from apex_lab.scene import ABSENT, Scene


def scene_identities(
    scene: Scene, size: tuple[int, int] | None = None, min_presence: float = 0.5, presence_after: bool = False
) -> Int[Tensor, "B T H W"]:
    """Identity of the winning component at every pixel, in the resolution of the ground truth.

    Args:
        scene: a model's output.
        size: (H, W) of the ground truth; soft masks of another size are resized before the argmax
            (metrics.md section 0). None keeps the masks' own size.
        min_presence: objects below it are absent (metrics.md section 2.4).
        presence_after: absent objects are taken out after the argmax and not before it: their pixels do not go to the
            next best component but to one segment of nothing, with an identity above all others.

    Raises:
        ValueError: a pixel was won by a component without an identity.
    """
    if size is not None and tuple(size) != tuple(scene.masks.shape[-2:]):
        scene = dataclasses.replace(
            scene,
            masks=resize_masks(scene.masks, size),
            reconstruction=scene.reconstruction.new_zeros(()).expand(*scene.reconstruction.shape[:3], *size),
            means=None,
        )
    # Scene.segmentation passes over components without identity; that they had nothing to win is checked here.
    winner = scene.masks.float().argmax(dim=2)
    nameless = scene.ids.gather(2, winner.flatten(2)) == ABSENT
    if bool(nameless.any()):
        raise ValueError(
            f"{float(nameless.double().mean()):.2%} of the pixels were won by a component without an identity "
            f"(id {ABSENT}): a model must give an absent component a zero mask, and a background component an id"
        )
    if not presence_after:
        return scene.segmentation(min_presence)
    found = scene.segmentation(min_presence=0.0)
    absent = (scene.presence < min_presence) & ~scene.background
    nothing = absent.gather(2, winner.flatten(2)).view_as(found)
    return torch.where(nothing, found.max() + 1, found)


def background_identities(scene: Scene) -> list[set[int]]:
    """Identities of the background components of each video of the batch (for `drop_background_slot`)."""
    return [set(ids[:, scene.background].flatten().tolist()) - {ABSENT} for ids in scene.ids]


def resize_masks(masks: Float[Tensor, "B T K H W"], size: tuple[int, int]) -> Float[Tensor, "B T K H2 W2"]:
    """Soft masks in another resolution, bilinearly (they still sum to 1 over K)."""
    resized = F.interpolate(masks.flatten(0, 1).float(), size=size, mode="bilinear", align_corners=False)
    return resized.unflatten(0, masks.shape[:2])

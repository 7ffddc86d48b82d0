"""Hard regions to a `Scene`: what the classical yardsticks share.

Legend: B videos, T frames, K components, H, W image height and width. Component 0 is the background.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.models.yardsticks.linking import link
from apex_lab.scene import ABSENT, BACKGROUND_ID, Context, Scene


def one_hot(labels: Int[Tensor, "B T H W"], components: int) -> Bool[Tensor, "B T K H W"]:
    """One mask per label 0 .. `components` - 1."""
    return labels[:, :, None] == torch.arange(components, device=labels.device)[:, None, None]


def mean_colors(video: Float[Tensor, "B T 3 H W"], masks: Bool[Tensor, "B T K H W"]) -> Float[Tensor, "B T K 3"]:
    """Mean RGB of the video under each mask; 0 under an empty one."""
    weights = masks.flatten(3).to(video.dtype)
    with torch.autocast(video.device.type, enabled=False):  # half precision cannot count pixels
        return weights @ video.flatten(3).transpose(2, 3) / weights.sum(dim=3, keepdim=True).clamp(min=1)


def scene_of_regions(
    video: Float[Tensor, "B T 3 H W"],
    labels: Int[Tensor, "B T H W"],
    components: int,
    background: Float[Tensor, "3 H W"] | None = None,
    context: Context | None = None,
) -> Scene:
    """A scene of hard masks: every region is its mean colour, linked over time by `link`.

    Args:
        video: RGB in [0, 1].
        labels: component of every pixel, 0 (background) .. `components` - 1; which number an object has in a frame
            carries no meaning.
        components: K, the same for every video.
        background: image of the background, RGB in [0, 1]; None paints it in its mean colour.
        context: its state is that of the frames before; with its detail the scene has `means`. None: `Context()`.

    Returns:
        A scene without loss terms and windows. `appearance` is the mean RGB (A = 3).
    """
    masks = one_hot(labels, components)
    colors = mean_colors(video, masks)
    ids = torch.full(masks.shape[:3], BACKGROUND_ID, dtype=torch.long, device=video.device)
    context = context or Context()
    linked = []
    for b in range(len(video)):
        before = None if context.state is None else context.state[b]
        found, last = link(masks[b, :, 1:].cpu().numpy(), colors[b, :, 1:].cpu().numpy(), before=before)
        linked.append(last)
        ids[b, :, 1:] = torch.from_numpy(found).to(video.device)
    means = colors[..., None, None].expand(*masks.shape[:3], *video.shape[2:])
    if background is not None:
        means = torch.cat([background.expand_as(means[:, :, :1]), means[:, :, 1:]], dim=2)
    scene = hard_scene(labels, masks, ids, colors, means)
    return dataclasses.replace(scene, state=linked, means=means if context.detail else None)


def hard_scene(
    labels: Int[Tensor, "B T H W"],
    masks: Bool[Tensor, "B T K H W"],
    ids: Int[Tensor, "B T K"],
    appearance: Float[Tensor, "B T K A"],
    means: Float[Tensor, "B T K 3 H W"],
) -> Scene:
    """A scene in which each pixel belongs to one component and shows that component's image.

    `masks` is `one_hot(labels, K)`, handed in because the callers have it.
    """
    owner = labels.long()[:, :, None, None].expand(-1, -1, 1, 3, -1, -1)
    return Scene(
        masks=masks.to(means.dtype),
        background=torch.arange(masks.shape[2], device=masks.device) == 0,
        ids=ids,
        presence=(ids != ABSENT).to(means.dtype),
        appearance=appearance,
        reconstruction=means.gather(2, owner).squeeze(2),
        terms={},
        means=means,
    )

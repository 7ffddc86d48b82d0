"""A small scene whose pictures can be foretold: two squares, one of which comes at frame 1, on a grey ground."""

from __future__ import annotations

import torch
from torch import Tensor

from apex_lab.scene import ABSENT, Scene
from apex_lab.view import Item

T, H, W = 4, 16, 24
RED, BLUE, GREY = (255, 0, 0), (0, 0, 255), (102, 102, 102)
FIRST, SECOND, BACKGROUND = 7, 3, 0
"""Identities of the first square, the second, and the background."""


def squares() -> tuple[Tensor, Tensor, Tensor]:
    """uint8 video (1, T, 3, H, W), its labels (1, T, H, W) and masks (1, T, 3, H, W); the background comes last."""
    video = torch.full((1, T, 3, H, W), 102, dtype=torch.uint8)
    labels = torch.zeros(1, T, H, W, dtype=torch.long)
    for t in range(T):
        labels[0, t, 2:8, 2 + t : 8 + t] = 1
        if t >= 1:
            labels[0, t, 9:15, 14:20] = 2
    for k, color in ((1, RED), (2, BLUE)):
        for c in range(3):
            video[:, :, c][labels == k] = color[c]
    masks = torch.stack([labels == 1, labels == 2, labels == 0], dim=2).float()
    return video, labels, masks


def scene(windows: bool = True, means: bool = True) -> Scene:
    """The scene a perfect model gives for `squares`, with identities 7, 3 and 0."""
    video, _, masks = squares()
    ids = torch.tensor([FIRST, SECOND, BACKGROUND]).repeat(1, T, 1)
    ids[:, 0, 1] = ABSENT
    window = torch.full((1, T, 3, 4), float("nan"))
    for t in range(T):
        window[0, t, 0] = torch.tensor([6 / H, 6 / W, 10 / H - 1, 2 * (5 + t) / W - 1])
        if t >= 1:
            window[0, t, 1] = torch.tensor([6 / H, 6 / W, 24 / H - 1, 34 / W - 1])
    colors = torch.tensor([RED, BLUE, GREY]) / 255
    return Scene(
        masks=masks,
        background=torch.tensor([False, False, True]),
        ids=ids,
        presence=(ids != ABSENT).float(),
        appearance=torch.zeros(1, T, 3, 1),
        reconstruction=video / 255,
        terms={"nll": torch.zeros(1)},
        windows=window if windows else None,
        means=colors[:, :, None, None].expand(1, T, 3, 3, H, W) if means else None,
    )


def item(name: str = "video 0", truth: bool = True, **parts: bool) -> Item:
    video, labels, _ = squares()
    return Item(name, video, scene(**parts), 0, labels if truth else None)

"""The smallest real model and the smallest real data set: what the tests of the house train."""

from __future__ import annotations

import hashlib
import os
import time
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.data import Clip, VideoSet, VideoSource
from apex_lab.scene import Context, Scene, SceneModel, Statistics

Count = Annotated[int, Field(ge=1)]


class Layers(SceneModel):
    """Explains every frame by `components` layers of one colour each, the first being the background."""

    term_names = ("error", "spread")
    schedule_ranges: ClassVar = {"noise": (0.0, 10.0)}

    base: Tensor

    def __init__(self, components: Count = 3, width: Count = 8) -> None:
        super().__init__()
        if components < 2:
            raise ValueError(f"components = {components} leaves no room for an object: give at least 2")
        self.components = components
        self.masks = nn.Sequential(nn.Conv2d(3, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, components, 1))
        self.register_buffer("base", torch.zeros(3, 1, 1))

    def initialise(self, statistics: Statistics) -> None:
        self.base.copy_(statistics.median.mean(dim=(1, 2), keepdim=True))

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        b, t = video.shape[:2]
        logits = self.masks((video - self.base).flatten(0, 1)).unflatten(0, (b, t))
        if self.training:
            logits = logits + context.schedule["noise"] * context.noise.normal(logits)
        masks = logits.softmax(dim=2)
        weights = masks.sum(dim=(-2, -1), keepdim=True).clamp_min(1e-6)
        colours = torch.einsum("btkhw,btchw->btkc", masks / weights, video)
        picture = torch.einsum("btkhw,btkc->btchw", masks, colours)
        ids = torch.arange(self.components, device=video.device).expand(b, t, -1)
        return Scene(
            masks=masks,
            background=torch.arange(self.components, device=video.device) == 0,
            ids=ids,
            presence=torch.ones_like(ids, dtype=masks.dtype),
            appearance=colours,
            reconstruction=picture.clamp(0, 1),
            terms={
                "error": (picture - video).square().sum(dim=(1, 2, 3, 4)),
                "spread": masks.var(dim=2).neg().mean(dim=(1, 2, 3)),
            },
            diagnostics={"largest": masks.amax(dim=2).mean().detach()},
        )


class Squares(VideoSet):
    """Videos of one coloured square that moves over a grey background.

    The environment can slow it down (TINY_PAUSE, seconds per clip) or break it (TINY_BROKEN_AT, a step).
    """

    def __init__(self, split: str, videos: int, frames: int, image_size: int, seed: int, labelled: bool = True) -> None:
        self.split, self.videos, self.frames, self.side, self.seed = split, videos, frames, image_size, seed
        self.labelled = labelled
        self.read_clips = 0

    def __len__(self) -> int:
        return self.videos

    def length(self, video: int) -> int:
        return self.frames

    @property
    def image_size(self) -> tuple[int, int]:
        return self.side, self.side

    def name(self, video: int) -> str:
        return f"{self.split}_{video:05d}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(self.seed * 1000 + clip.video)
        side = self.side // 4
        x, y = torch.randint(0, self.side - side - self.frames, (2,), generator=generator).tolist()
        colour = torch.randint(100, 255, (3, 1, 1), generator=generator)
        video = torch.full((self.frames, 3, self.side, self.side), 60, dtype=torch.uint8)
        segmentation = torch.zeros(self.frames, self.side, self.side, dtype=torch.uint8)
        for t in range(self.frames):
            video[t, :, y : y + side, x + t : x + t + side] = colour.to(torch.uint8)
            segmentation[t, y : y + side, x + t : x + t + side] = 2
        frames = slice(clip.start, None if clip.frames is None else clip.start + clip.frames)
        found = {"video": video[frames], "segmentation": segmentation[frames]}
        return found if self.labelled else {"video": found["video"]}


class TrainingSquares(Squares):
    """The training split, whose clips take time or break as the environment says."""

    def read(self, clip: Clip) -> dict[str, Tensor]:
        time.sleep(float(os.environ.get("TINY_PAUSE", 0)) / 2)
        if int(os.environ.get("TINY_BROKEN_AT", -1)) * 2 == self.read_clips - 1:
            raise RuntimeError(f"the data broke at step {os.environ['TINY_BROKEN_AT']}")
        self.read_clips += 1
        return super().read(clip)

    def median(self, sample: int | None = None) -> Float[Tensor, "3 H W"]:
        return torch.full((3, self.side, self.side), 60 / 255)


class SquaresSource(VideoSource):
    """Three splits of `Squares`."""

    def __init__(
        self,
        image_size: Annotated[int, Field(ge=8)] = 32,
        frames: Count = 3,
        train: Count = 6,
        val: Count = 2,
        test: Count = 2,
        data_seed: Annotated[int, Field(ge=0)] = 0,
        workers: Annotated[int, Field(ge=0)] = 0,
        labelled: bool = True,
    ) -> None:
        self.workers = workers
        self.settings = {"image_size": image_size, "frames": frames, "train": train, "val": val, "test": test}
        kinds = {"train": TrainingSquares, "val": Squares, "test": Squares}
        self.sets = {
            name: kind(name, self.settings[name], frames, image_size, data_seed + i, labelled)
            for i, (name, kind) in enumerate(kinds.items())
        }
        self.seed = data_seed

    def prepare(self) -> None:
        """Nothing to fetch."""

    def open(self) -> None:
        """Nothing to read."""

    @property
    def fingerprint(self) -> str:
        return hashlib.sha256(repr((self.settings, self.seed)).encode()).hexdigest()[:32]

    def describe(self) -> dict[str, Any]:
        return {"name": "squares", "fingerprint": self.fingerprint, "settings": {**self.settings, "seed": self.seed}}

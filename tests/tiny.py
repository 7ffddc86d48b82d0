"""The smallest real model and the smallest real data set: what the tests of the house train."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, Subset

from apex_lab.scene import Scene, SceneModel, Schedule

Count = Annotated[int, Field(ge=1)]


class Layers(SceneModel):
    """Explains every frame by `components` layers of one colour each, the first being the background."""

    term_names = ("error", "spread")
    schedule_names = ("noise",)

    base: Tensor

    def __init__(self, components: Count = 3, width: Count = 8) -> None:
        super().__init__()
        if components < 2:
            raise ValueError(f"components = {components} leaves no room for an object: give at least 2")
        self.components = components
        self.masks = nn.Sequential(nn.Conv2d(3, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, components, 1))
        self.register_buffer("base", torch.zeros(3, 1, 1))

    def initialise(self, median: Float[Tensor, "3 H W"]) -> None:
        self.base.copy_(median.mean(dim=(1, 2), keepdim=True))

    def forward(self, video: Float[Tensor, "B T 3 H W"], schedule: Schedule) -> Scene:
        b, t = video.shape[:2]
        logits = self.masks((video - self.base).flatten(0, 1)).unflatten(0, (b, t))
        if self.training:
            logits = logits + schedule["noise"] * torch.randn_like(logits)
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


class Squares(Dataset[dict[str, Any]]):
    """Videos of one coloured square that moves over a grey background."""

    def __init__(self, videos: int, frames: int, image_size: int, seed: int) -> None:
        self.videos, self.frames, self.image_size, self.seed = videos, frames, image_size, seed

    def __len__(self) -> int:
        return self.videos

    def __getitem__(self, index: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(self.seed * 1000 + index)
        side = self.image_size // 4
        x, y = torch.randint(0, self.image_size - side - self.frames, (2,), generator=generator).tolist()
        colour = torch.randint(100, 255, (3, 1, 1), generator=generator)
        video = torch.full((self.frames, 3, self.image_size, self.image_size), 60, dtype=torch.uint8)
        segmentation = torch.zeros(self.frames, self.image_size, self.image_size, dtype=torch.uint8)
        for t in range(self.frames):
            video[t, :, y : y + side, x + t : x + t + side] = colour.to(torch.uint8)
            segmentation[t, y : y + side, x + t : x + t + side] = 2
        return {"video": video, "segmentation": segmentation, "index": index}


class Steps:
    """The batches of all steps that are left."""

    def __init__(self, module: SquaresModule) -> None:
        self._module = module

    def __iter__(self) -> Iterator[list[int]]:
        return self._module.order()

    def __len__(self) -> int:
        return self._module.max_steps - self._module.start_step


class SquaresModule:
    """Batches of `Squares`; the batches of a step depend on the seed and the step alone.

    The environment can slow it down (TINY_PAUSE, seconds per batch) or break it (TINY_BROKEN_AT, a step).
    """

    def __init__(
        self,
        image_size: Annotated[int, Field(ge=8)] = 32,
        frames: Count = 3,
        train: Count = 6,
        val: Count = 2,
        test: Count = 2,
        batch_size: Count = 2,
        seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        sizes = {"train": train, "val": val, "test": test}
        self.sets = {name: Squares(n, frames, image_size, seed + i) for i, (name, n) in enumerate(sizes.items())}
        self.batch_size = batch_size
        self.fingerprint = hashlib.sha256(repr((image_size, frames, sizes, seed)).encode()).hexdigest()
        self.seed = seed
        self.start_step = 0
        self.max_steps = 0

    def prepare_data(self) -> None:
        """Nothing to fetch."""

    def setup(self, stage: str | None = None) -> None:
        """Nothing to read."""

    def train_median(self) -> Float[Tensor, "3 H W"]:
        size = self.sets["train"].image_size
        return torch.full((3, size, size), 60 / 255)

    def order(self) -> Iterator[list[int]]:
        count = len(self.sets["train"])
        for step in range(self.start_step, self.max_steps):
            time.sleep(float(os.environ.get("TINY_PAUSE", 0)))
            if step == int(os.environ.get("TINY_BROKEN_AT", -1)):
                raise RuntimeError(f"the data broke at step {step}")
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + step)
            yield torch.randint(0, count, (self.batch_size,), generator=generator).tolist()

    def train_dataloader(self) -> DataLoader[dict[str, Any]]:
        return DataLoader(self.sets["train"], batch_sampler=Steps(self))

    def loader(self, split: str, videos: int | None = None) -> DataLoader[dict[str, Any]]:
        data = self.sets[split]
        chosen = range(len(data) if videos is None else min(videos, len(data)))
        return DataLoader(Subset(data, chosen), batch_size=self.batch_size)

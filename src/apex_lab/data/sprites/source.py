"""`data=sprites`: coloured shapes that move over a plain ground, drawn when they are read, or once into a recording."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText
from apex_lab.data.recorded import RecordedSet, RecordedSource, Verify
from apex_lab.data.sprites.drawing import COLOURS, SHAPES, VERSION, Sprite, draw_sprites, drawn, hidden
from apex_lab.data.sprites.recording import KIND, Drawer, plan
from apex_lab.data.video_set import Clip, VideoSet
from apex_lab.metrics.objects import ObjectMetadata
from recordings import Plan


class Sprites(VideoSet):
    """One split. Labels: 0 the ground, 1 and up the sprites, each the same number through the video.

    Args:
        seed: of all splits.
        split: "train", "val" or "test".
        videos, frames, side: sizes; `side` in pixels.
        counts: fewest and most sprites of a video.
    """

    def __init__(self, seed: int, split: str, videos: int, frames: int, side: int, counts: tuple[int, int]) -> None:
        self.seed, self.split, self.counts = seed, split, counts
        self.videos, self.frames, self.side = videos, frames, side

    def __len__(self) -> int:
        return self.videos

    def length(self, video: int) -> int:
        """Frames of a video; all have the same number."""
        return self.frames

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.side, self.side

    def name(self, video: int) -> str:
        """As exports name it."""
        return f"{self.split}_{video:05d}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        """Draws a clip."""
        sprites = self.sprites(clip.video)
        stop = self.frames if clip.frames is None else clip.start + clip.frames
        if not 0 <= clip.start < stop <= self.frames:
            raise IndexError(f"frames {clip.start} to {stop - 1} of a video that has {self.frames}")
        images, labels = zip(*(drawn(sprites, frame, self.side) for frame in range(clip.start, stop)), strict=True)
        return {
            "video": torch.from_numpy(np.stack(images).transpose(0, 3, 1, 2).copy()),
            "segmentation": torch.from_numpy(np.stack(labels)),
        }

    def sprites(self, video: int) -> list[Sprite]:
        """The sprites of a video, the nearest last."""
        return draw_sprites(self.seed, self.split, video, self.counts)

    def metadata(self, video: int) -> ObjectMetadata:
        """Shape as the class, and hidden share per frame."""
        sprites = self.sprites(video)
        return ObjectMetadata(
            labels=np.arange(1, len(sprites) + 1),
            classes=[SHAPES[sprite.shape] for sprite in sprites],
            occlusion=np.array([hidden(sprites, frame, self.side) for frame in range(self.frames)]),
        )


class StoredSprites(RecordedSet):
    """One split out of a recording; what no array holds is that of the drawn split.

    Args:
        root: folder of the recording.
        drawn: the same split.
    """

    def __init__(self, root: Path, drawn: Sprites) -> None:
        super().__init__(root, KIND, drawn.split)
        self.drawn = drawn

    def metadata(self, video: int) -> ObjectMetadata:
        """As of `Sprites`."""
        return self.drawn.metadata(video)


class SpritesSource(RecordedSource):
    """Sprites with the given settings. Drawn or stored, the videos are the same.

    Args:
        data_seed: of all videos.
        train, val, test: videos per split.
        frames: per video.
        image_size: height and width in pixels.
        min_objects, max_objects: fewest and most sprites of a video.
        workers: processes that draw or load training clips; 0 does that in the training process.
        stored: draw every video once, into a folder below `root`, and read it from there. False: nothing is stored.
        root: folder of all data sets.
        generate, sim_workers, verify: of what is stored, as of `RecordedSource`.

    Raises:
        UserError: more sprites than colours, or fewer at most than at least.
    """

    kind = KIND

    def __init__(
        self,
        data_seed: Annotated[int, Field(ge=0)] = 0,
        train: Annotated[int, Field(gt=0)] = 2000,
        val: Annotated[int, Field(ge=0)] = 200,
        test: Annotated[int, Field(ge=0)] = 200,
        frames: Annotated[int, Field(gt=0)] = 20,
        image_size: Annotated[int, Field(ge=16, le=1024)] = 128,
        min_objects: Annotated[int, Field(ge=0)] = 2,
        max_objects: Annotated[int, Field(ge=1, le=len(COLOURS))] = 4,
        workers: Annotated[int, Field(ge=0)] = 2,
        stored: bool = False,
        root: PathText = "data",
        generate: bool = True,
        sim_workers: Annotated[int, Field(gt=0)] | None = None,
        verify: Verify = "changed",
    ) -> None:
        if min_objects > max_objects:
            raise UserError(f"min_objects = {min_objects} is above max_objects = {max_objects}")
        super().__init__(workers, generate, sim_workers, verify)
        self.stored, self.root = stored, Path(root).expanduser().absolute()
        self.settings = {
            **{"data_seed": data_seed, "train": train, "val": val, "test": test, "frames": frames},
            **{"image_size": image_size, "min_objects": min_objects, "max_objects": max_objects},
        }

    def refuse_missing(self) -> None:
        """Looks whether data that may not be made are there; what is drawn as it is read is never missing.

        Raises:
            UserError: they are not.
        """
        if self.stored:
            super().refuse_missing()

    def prepare(self) -> None:
        """Draws what is to be stored and is not there; else there is nothing to do."""
        if self.stored:
            super().prepare()

    def opened(self, split: str) -> VideoSet:
        """One split."""
        settings = self.settings
        counts = settings["min_objects"], settings["max_objects"]
        sizes = settings[split], settings["frames"], settings["image_size"]
        sprites = Sprites(settings["data_seed"], split, *sizes, counts)
        return StoredSprites(self.folder, sprites) if self.stored else sprites

    @property
    def folder(self) -> Path:
        """Where the videos are, if they are stored."""
        settings = self.settings
        size = f"{settings['image_size']}px_{settings['frames']}f"
        return self.root / f"sprites_{size}_{self._plan.fingerprint[:8]}"

    def plan(self) -> Plan[dict[str, Any]]:
        """What the folder must hold."""
        return self._plan

    @cached_property
    def _plan(self) -> Plan[dict[str, Any]]:
        return plan(self.settings)

    def maker(self) -> Drawer:
        """Draws the videos."""
        return Drawer(self.settings)

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal videos."""
        return hashlib.sha256(repr((VERSION, sorted(self.settings.items()))).encode()).hexdigest()[:32]

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data."""
        where: Mapping[str, Any] = {"folder": str(self.folder)} if self.stored else {}
        about = {"name": "sprites", "fingerprint": self.fingerprint, "version": VERSION, "settings": self.settings}
        return {**about, **where}

"""Clips of the arrangement task's table: what models are trained on that are to arrange objects."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from apex_lab.base.validation import PathText, validate
from apex_lab.data.recorded import RecordedSet, RecordedSource, Verify, merged
from apex_lab.metrics.objects import ObjectMetadata
from recordings import Plan
from sims.arrangement_clips.recording import KIND, Clips, make, plan
from sims.arrangement_clips.settings import Settings
from sims.stage import FIRST_OBJECT_ID


class ArrangementClips(RecordedSet):
    """One split of a finished folder. Labels: 0 background, 2 and up objects, as in P2D; there is no arm."""

    def __init__(self, root: str | Path, split: str) -> None:
        super().__init__(root, KIND, split)

    def metadata(self, video: int) -> ObjectMetadata:
        """Class of every object."""
        classes = self.reader.array("classes")[video]
        used = np.flatnonzero(classes >= 0)
        known = self.manifest.facts["classes"]
        return ObjectMetadata(FIRST_OBJECT_ID + used, [known[classes[slot]] for slot in used])


class ArrangementSource(RecordedSource):
    """Clips of the objects on the table of the arrangement task: same camera, same objects, no arm.

    In a clip some objects slide over the table, so models that track see motion. No clip shows a scenario of the task:
    their random numbers have nothing in common.

    Args:
        root: folder of all data sets.
        data_seed: of the clips.
        train: clips for training.
        val: clips for validation.
        test: clips for testing.
        frames: frames per clip.
        image_size: height and width in pixels.
        simulation: further settings (`sims.arrangement_clips.settings.Settings`), for example max_objects.
        workers: processes that load training clips; 0 loads in the training process.
        generate: make missing data; False: refuse.
        sim_workers: processes that make data; None: one per core.
        verify: as of `RecordedSource`.

    Raises:
        UserError: impossible settings.
    """

    kind = KIND

    def __init__(
        self,
        root: PathText,
        data_seed: Annotated[int, Field(ge=0)] = 0,
        train: Annotated[int, Field(gt=0)] = 2000,
        val: Annotated[int, Field(ge=0)] = 200,
        test: Annotated[int, Field(ge=0)] = 200,
        frames: Annotated[int, Field(gt=0)] = 20,
        image_size: Annotated[int, Field(ge=16, le=1024)] = 128,
        simulation: dict[str, Any] | None = None,
        workers: Annotated[int, Field(ge=0)] = 2,
        generate: bool = True,
        sim_workers: Annotated[int, Field(gt=0)] | None = None,
        verify: Verify = "changed",
    ) -> None:
        super().__init__(workers, generate, sim_workers, verify)
        sizes = {"train": train, "val": val, "test": test, "frames": frames, "image_size": image_size}
        settings = validate(Settings, merged({"seed": data_seed, **sizes}, simulation), "simulation")
        assert isinstance(settings, Settings)
        self.settings = settings
        name = f"arrangement_{image_size}px_{frames}f_{self.plan().fingerprint[:8]}"
        self._folder = Path(root).expanduser().absolute() / name

    @property
    def folder(self) -> Path:
        """Where the data set is."""
        return self._folder

    def plan(self) -> Plan[Settings]:
        """What the folder must hold."""
        return plan(self.settings)

    def maker(self) -> Clips:
        """Draws the clips."""
        return Clips(self.settings)

    def make(self) -> None:
        """Draws missing data."""
        make(self.folder, self.settings, self.sim_workers)

    def make_command(self) -> str:
        """The shell command that draws missing data."""
        words = shlex.quote(json.dumps(self.settings.model_dump(mode="json", exclude_defaults=True)))
        return f"{super().make_command()} --settings {words}"

    def opened(self, split: str) -> ArrangementClips:
        """One split."""
        return ArrangementClips(self.folder, split)

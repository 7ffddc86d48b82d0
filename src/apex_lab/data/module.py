"""P2D for training: makes the data where they are missing, checks them, serves batches that a run can resume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from lightning import LightningDataModule
from pydantic import Field, ValidationError
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from apex_lab.base.errors import UserError
from apex_lab.data.batches import TrainBatches
from apex_lab.data.p2d import P2D
from sims.errors import SimError
from sims.p2d.generate import generate
from sims.p2d.manifest import MANIFEST, Manifest, fingerprint
from sims.p2d.settings import Settings
from sims.p2d.settings_text import command_words, sentence
from sims.p2d.verify import check, is_verified, verify

Loader = DataLoader[dict[str, Any]]


class P2DModule(LightningDataModule):
    """The Panda Pushing Dataset with the given settings, in a folder of its own below `root`.

    The folder's name holds a fingerprint of the settings, so different data never meet; whoever wants data that are
    there already uses them, and processes that want the same missing data make them once.

    Before `train_dataloader`, set `max_steps`, and `start_step` to go on with a run: the batch of step n depends on
    (seed, n) alone.

    Args:
        root: folder of all data sets.
        seed: of the order of training videos.
        data_seed: of the simulation.
        train: trajectories for training.
        val: trajectories for validation.
        test: trajectories for testing.
        frames: frames per trajectory.
        image_size: height and width in pixels.
        simulation: further settings of the simulation (`sims.p2d.settings.Settings`), for example max_objects.
        batch_size: videos per training step.
        eval_batch_size: videos per validation and test step; None: as `batch_size`.
        workers: processes that load data; 0 loads in the training process.
        generate: make missing data; False: refuse.
        sim_workers: processes that make data; None: one per core.
        verify: when to compare all bytes with their checksums: "changed" when any file was touched since that was last
            done, "always", or "never". Sizes and headers are checked in any case.

    Raises:
        UserError: impossible settings.
    """

    def __init__(
        self,
        root: str,
        seed: Annotated[int, Field(ge=0)] = 0,
        data_seed: Annotated[int, Field(ge=0)] = 0,
        train: Annotated[int, Field(gt=0)] = 2000,
        val: Annotated[int, Field(ge=0)] = 200,
        test: Annotated[int, Field(ge=0)] = 200,
        frames: Annotated[int, Field(gt=0)] = 20,
        image_size: Annotated[int, Field(ge=16, le=1024)] = 128,
        simulation: dict[str, Any] | None = None,
        batch_size: Annotated[int, Field(gt=0)] = 4,
        eval_batch_size: Annotated[int, Field(gt=0)] | None = None,
        workers: Annotated[int, Field(ge=0)] = 2,
        generate: bool = True,
        sim_workers: Annotated[int, Field(gt=0)] | None = None,
        verify: Literal["changed", "always", "never"] = "changed",
    ) -> None:
        super().__init__()
        sizes = {"train": train, "val": val, "test": test, "frames": frames, "image_size": image_size}
        self.settings = _settings({"seed": data_seed, **sizes}, simulation or {})
        self.seed, self.workers = seed, workers
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.generate, self.sim_workers, self.verify = generate, sim_workers, verify
        name = f"p2d_{image_size}px_{frames}f_{fingerprint(self.settings)[:8]}"
        self.folder = Path(root).expanduser().absolute() / name
        self.start_step = 0
        self.max_steps: int | None = None
        self.sets: dict[str, P2D] = {}

    def prepare_data(self) -> None:
        """Makes sure that the data are there and are right; the first time that can take minutes.

        Raises:
            UserError: they are missing and cannot or may not be made, are damaged, or the disk is full.
        """
        try:
            self._prepare()
        except SimError as error:
            raise UserError(str(error)) from error

    def _prepare(self) -> None:
        if not (self.folder / MANIFEST).exists():
            if not self.generate:
                command = f"python -m sims.p2d --out {self.folder} {command_words(self.settings)}".strip()
                raise UserError(f"no finished P2D data at {self.folder}: set data.generate=true or run {command}")
            generate(self.folder, self.settings, workers=self.sim_workers)
        manifest = check(self.folder, self.settings)
        if self.verify == "always" or (self.verify == "changed" and not is_verified(self.folder, manifest)):
            damage = verify(self.folder, manifest)
            if damage:
                lines = damage.lines()
                more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
                raise UserError(
                    f"{self.folder} is damaged ({lines[0]}{more}): "
                    f"mend it with python -m sims.p2d verify {self.folder} --repair"
                )

    def setup(self, stage: str | None = None) -> None:
        """Opens the splits."""
        if not self.sets:
            self.sets = {split: P2D(self.folder, split) for split in ("train", "val", "test")}

    def train_dataloader(self) -> Loader:
        """Batches of the steps from `start_step` up to `max_steps`, in a row without epochs."""
        if self.max_steps is None:
            raise UserError("P2DModule.max_steps is not set: set it to the number of training steps before training")
        batches = TrainBatches(self.settings.train, self.batch_size, self.seed, self.start_step, self.max_steps)
        return DataLoader(self.sets["train"], batch_sampler=batches, **self._options())

    def val_dataloader(self) -> Loader:
        """All validation videos in order."""
        return self.loader("val")

    def test_dataloader(self) -> Loader:
        """All test videos in order."""
        return self.loader("test")

    def loader(self, split: str, videos: int | None = None) -> Loader:
        """The first videos of a split (None: all) in order, `eval_batch_size` at a time."""
        data: P2D | Subset[dict[str, Any]] = self.sets[split]
        if videos is not None:
            data = Subset(self.sets[split], range(min(videos, len(self.sets[split]))))
        return DataLoader(data, batch_size=self.eval_batch_size, **self._options())

    def train_median(self) -> Float[Tensor, "3 H W"]:
        """Per-pixel median picture of the training split, in [0, 1]; call after `setup`."""
        return self.sets["train"].median()

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal bytes; call after `prepare_data`."""
        return self._manifest().content

    def _manifest(self) -> Manifest:
        try:
            return check(self.folder, self.settings)
        except SimError as error:
            raise UserError(str(error)) from error

    def describe(self) -> dict[str, Any]:
        """What the record of a run keeps about its data; call after `prepare_data`."""
        manifest = self._manifest()
        counts = {split: getattr(self.settings, split) for split in ("train", "val", "test")}
        return {
            "name": "p2d",
            "folder": str(self.folder),
            "fingerprint": manifest.fingerprint,
            "content": manifest.content,
            "frames": self.settings.frames,
            "image_size": self.settings.image_size,
            "versions": manifest.facts["versions"],
            **counts,
        }

    def _options(self) -> dict[str, Any]:
        # A generator of its own: starting a loader must not change the random numbers of the training.
        return {
            "num_workers": self.workers,
            "persistent_workers": self.workers > 0,
            "pin_memory": torch.cuda.is_available(),
            "generator": torch.Generator().manual_seed(self.seed),
        }


def _settings(fixed: dict[str, Any], further: Mapping[str, Any]) -> Settings:
    for key in further:
        if key in fixed:
            word = "data_seed" if key == "seed" else key
            raise UserError(f"simulation.{key} is not a key: set data.{word} instead")
    try:
        return Settings(**fixed, **_plain(further))
    except ValidationError as error:
        raise UserError(sentence(error)) from None


def _plain(value: Any) -> Any:
    """Configuration nodes as plain dicts and lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value

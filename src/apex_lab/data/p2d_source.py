"""P2D as a source of a run: makes the data where they are missing, checks and opens them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText
from apex_lab.data.p2d import P2D
from apex_lab.data.source import VideoSource
from sims.errors import SimError
from sims.p2d.generate import generate
from sims.p2d.manifest import MANIFEST, Manifest, fingerprint
from sims.p2d.settings import Settings
from sims.p2d.settings_text import command_words, sentence
from sims.p2d.verify import check, is_verified, verify


class P2DSource(VideoSource):
    """The Panda Pushing Dataset with the given settings, in a folder of its own below `root`.

    The folder's name holds a fingerprint of the settings, so different data never meet. Data that exist are used;
    processes that need the same missing data make them once.

    Args:
        root: folder of all data sets.
        data_seed: of the simulation.
        train: trajectories for training.
        val: trajectories for validation.
        test: trajectories for testing.
        frames: frames per trajectory.
        image_size: height and width in pixels.
        simulation: further settings of the simulation (`sims.p2d.settings.Settings`), for example max_objects.
        workers: processes that load training clips; 0 loads in the training process.
        generate: make missing data; False: refuse.
        sim_workers: processes that make data; None: one per core.
        verify: when to compare all bytes with their checksums: "changed" when any file was touched since that was last
            done, "always", or "never". Sizes and headers are checked in any case.

    Raises:
        UserError: impossible settings.
    """

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
        verify: Literal["changed", "always", "never"] = "changed",
    ) -> None:
        sizes = {"train": train, "val": val, "test": test, "frames": frames, "image_size": image_size}
        self.settings = _settings({"seed": data_seed, **sizes}, simulation or {})
        self.workers = workers
        self.generate, self.sim_workers, self.verify = generate, sim_workers, verify
        name = f"p2d_{image_size}px_{frames}f_{fingerprint(self.settings)[:8]}"
        self.folder = Path(root).expanduser().absolute() / name
        self.sets: dict[str, P2D] = {}

    def prepare(self) -> None:
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
                    f"repair it with python -m sims.p2d verify {self.folder} --repair"
                )

    def open(self) -> None:
        """Opens the splits."""
        if not self.sets:
            self.sets = {split: P2D(self.folder, split) for split in ("train", "val", "test")}

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal bytes; call after `prepare`."""
        return self._manifest().content

    def _manifest(self) -> Manifest:
        try:
            return check(self.folder, self.settings)
        except SimError as error:
            raise UserError(str(error)) from error

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data; call after `prepare`."""
        manifest = self._manifest()
        return {
            "name": "p2d",
            "folder": str(self.folder),
            "fingerprint": manifest.content,
            "settings": self.settings.model_dump(mode="json"),
            "versions": manifest.facts["versions"],
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

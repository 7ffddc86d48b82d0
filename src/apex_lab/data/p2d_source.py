"""P2D as a source of a run: makes the data where they are missing, checks and opens them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText
from apex_lab.data.p2d import P2D
from apex_lab.data.recorded import RecordedSource, Verify, merged
from recordings import Plan
from sims.p2d.generate import SIMULATOR, Simulator, generate
from sims.p2d.settings import Settings
from sims.p2d.settings_text import command_words, sentence
from sims.p2d.store import KIND, plan


class P2DSource(RecordedSource):
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
        sizes = {"train": train, "val": val, "test": test, "frames": frames, "image_size": image_size}
        self.settings = _settings(merged({"seed": data_seed, **sizes}, simulation))
        super().__init__(workers, generate, sim_workers, verify)
        name = f"p2d_{image_size}px_{frames}f_{self.plan().fingerprint[:8]}"
        self._folder = Path(root).expanduser().absolute() / name

    @property
    def folder(self) -> Path:
        """Where the data set is."""
        return self._folder

    def plan(self) -> Plan[Settings]:
        """What the folder must hold."""
        return plan(self.settings)

    def maker(self) -> Simulator:
        """The simulation."""
        return Simulator(self.settings, SIMULATOR)

    def make(self) -> None:
        """Simulates missing data."""
        generate(self.folder, self.settings, workers=self.sim_workers)

    def make_command(self) -> str:
        """The shell command that simulates missing data."""
        return f"python -m sims.p2d --out {self.folder} {command_words(self.settings)}".strip()

    def opened(self, split: str) -> P2D:
        """One split."""
        return P2D(self.folder, split)


def _settings(values: Mapping[str, Any]) -> Settings:
    try:
        return Settings(**_plain(values))
    except ValidationError as error:
        raise UserError(sentence(error)) from None


def _plain(value: Any) -> Any:
    """Configuration nodes as plain dicts and lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value

"""Generates a P2D folder, resumes an interrupted generation, or repairs a damaged folder."""

from __future__ import annotations

import dataclasses
import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import recordings
from recordings import Damage, Facts, Item, Maker
from sims.bullet import INSTALL
from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.store import FIELDS, KIND, Manifest, plan

SIMULATOR = "sims.p2d.simulator"
"""Module with `simulate(settings, split, index) -> Trajectory` and `facts(settings) -> Facts`."""

RECYCLE = 200
"""Trajectories after which a worker is replaced: the physics engine's memory grows with every reset."""


@dataclass(frozen=True)
class Simulator(Maker):
    """Makes trajectories in the workers, which alone import the simulator."""

    settings: Settings
    module: str

    def facts(self) -> Facts:
        """Versions of everything besides the settings that determines the bytes, the camera, the class names."""
        facts: Facts = self._import().facts(self.settings)
        return facts

    def make(self, split: str, index: int) -> Item:
        """Simulates one trajectory."""
        trajectory = self._import().simulate(self.settings, split, index)
        arrays = {field.name: getattr(trajectory, field.name) for field in dataclasses.fields(trajectory)}
        return Item({name: arrays[name] for name in FIELDS}, {"redraws": int(trajectory.redraws)})

    def _import(self) -> ModuleType:
        try:
            return importlib.import_module(self.module)
        except ModuleNotFoundError as error:
            raise SimError(
                f"P2D cannot be simulated here because the package {error.name!r} is not installed: install it (for "
                f"pybullet, {INSTALL}), or make the data on another machine and copy the folder"
            ) from None


def generate(
    root: Path,
    settings: Settings,
    *,
    workers: int | None = None,
    shown: bool = True,
    simulator: str = SIMULATOR,
    recycle: int = RECYCLE,
) -> Manifest:
    """Generates the data set with these settings in `root`; finished trajectories are kept.

    The bytes depend on the settings and the versions of the simulator alone: not on the number of workers, the order
    in which they finish, or interruptions. A second process with the same folder waits for the first.

    Args:
        root: the folder; made if it does not exist.
        settings: settings of the data set.
        workers: number of processes; None: one per core.
        shown: whether progress is shown on stderr.
        simulator: module that simulates (tests bring their own).
        recycle: trajectories after which a worker is replaced.

    Raises:
        SimError: the folder has other content, the disk is full, the simulator is missing or its workers keep dying.
    """
    maker = Simulator(settings, simulator)
    return recordings.record(root, plan(settings), maker, workers=workers, shown=shown, recycle=recycle)


def repair(
    root: Path,
    *,
    workers: int | None = None,
    shown: bool = True,
    simulator: str = SIMULATOR,
) -> Damage:
    """Checks a folder fully and generates its damaged trajectories, and only those, again; returns the damage found.

    A trajectory is written only if its checksum is the recorded one, so intact data are never replaced by other data,
    and a killed repair can be started again.

    Raises:
        SimError: as `generate`; also if a trajectory does not have its recorded checksum.
    """
    return recordings.repair(
        root,
        KIND,
        lambda plan, _: Simulator(plan.settings, simulator),
        workers=workers,
        shown=shown,
        recycle=RECYCLE,
    )

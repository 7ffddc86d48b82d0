"""What the parent and its workers exchange; imports no PyTorch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sims.arrangement.settings import Settings


@dataclass(frozen=True)
class Task:
    """One scenario: number of objects, index, and where its video goes (None: no video)."""

    objects: int
    index: int
    film: Path | None = None

    @property
    def name(self) -> str:
        """As on the command line: "4/17"."""
        return f"{self.objects}/{self.index}"


@dataclass(frozen=True)
class Setting:
    """What all scenarios of a command share. It is sent to other processes, so it holds no model.

    Attributes:
        perception: node of a `Perception`.
        checkpoint: file with the model's weights; None where none is needed.
        digest: SHA-256 of that file.
        trusted: as of `checkpoints.load`.
        device: name of the device that models run on.
        world: settings of the simulation.
        seed: of the scenarios.
    """

    perception: Mapping[str, Any]
    checkpoint: Path | None
    digest: str | None
    trusted: bool
    device: str
    world: Settings
    seed: int


@dataclass(frozen=True)
class Failure:
    """Why a scenario has no outcome.

    Attributes:
        reason: on one line.
        details: a traceback.
        final: every scenario would fail so.
    """

    reason: str
    details: str = ""
    final: bool = False


Answer = dict[str, Any] | Failure
"""An outcome as plain data (`sims.arrangement.types.Outcome`, and `seconds` of processor time), or a failure."""

Serve = Callable[[Connection, Setting], None]
"""What a worker does: it receives a `Task`, answers with an `Answer`, until the connection is closed."""


def digest_of(file: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()

"""What the tests of the P2D folder share: small settings, a folder's bytes, generators as processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from sims.p2d.generate import generate
from sims.p2d.settings import Settings
from sims.p2d.store import Manifest

FAKE = "tests.fakes.p2d_fake"
REPOSITORY = Path(__file__).resolve().parents[2]

SCRIPT = f"""
import sys
from pathlib import Path
from sims.p2d import __main__ as command, generate as module
module.SIMULATOR = "{FAKE}"
make, repair = module.generate, module.repair
command.generate = lambda *a, **k: make(*a, simulator="{FAKE}", **k)
command.repair = lambda *a, **k: repair(*a, simulator="{FAKE}", **k)
sys.exit(command.main(sys.argv[1:]))
"""
"""`python -m sims.p2d` with the fake simulator."""


def small(**changes: object) -> Settings:
    """Settings of a data set of a few kilobytes."""
    return Settings(**{"train": 8, "val": 2, "test": 2, "frames": 3, "image_size": 16, **changes})  # type: ignore[arg-type]


def make(root: Path, settings: Settings | None = None, workers: int = 1, recycle: int = 1000) -> Manifest:
    """A finished folder made by the fake simulator."""
    return generate(root, settings or small(), workers=workers, simulator=FAKE, recycle=recycle, shown=False)


def content(root: Path) -> dict[str, bytes]:
    """Relative path -> bytes of every visible file."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def words(settings: Settings) -> list[str]:
    """The `--set` part of a command for the settings that `small` changes."""
    keys = ("train", "val", "test", "frames", "image_size", "seed")
    return ["--set", *(f"{key}={getattr(settings, key)}" for key in keys)]


def start(*arguments: object, **environment: object) -> subprocess.Popen[str]:
    """`python -m sims.p2d` with the fake simulator, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *map(str, arguments)],
        cwd=REPOSITORY,
        env={**os.environ, **{name: str(value) for name, value in environment.items()}},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def children(pid: int) -> list[int]:
    """Living child processes of a process (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:  # ended in the meantime
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found

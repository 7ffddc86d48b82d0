"""Trained weights that come with the package, by name."""

from __future__ import annotations

from pathlib import Path

from apex_lab.base.errors import UserError

_FILES = {"apex-p2d-cpu": "apex_p2d_cpu.ckpt"}

NAMES = tuple(_FILES)
"""What `checkpoint=` and `apex_lab.load` take in place of a file."""


def weights(name: str) -> Path:
    """The checkpoint of a name: inside the installed package, else in the repository.

    Raises:
        UserError: it is not there (a damaged installation).
    """
    package = Path(__file__).resolve().parent.parent
    file = _FILES[name]
    for path in (package / "weights" / file, package.parent.parent / "sweeps" / "results" / file):
        if path.is_file():
            return path
    raise UserError(f"The weights {name} are not at {package / 'weights' / file}: install apex_lab again.")

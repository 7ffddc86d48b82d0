"""apex_lab: APEX and its baselines for unsupervised video segmentation and tracking in robot manipulation.

segmenter = apex_lab.load("apex-p2d-cpu")  # or a .ckpt file, or a run folder
scene = segmenter(frames)                  # uint8 (T, H, W, 3), NumPy or PyTorch
"""

from __future__ import annotations

import importlib
import signal
import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # a command is starting: until it listens itself, Ctrl-C ends it without a traceback of its imports
    signal.signal(signal.SIGINT, signal.SIG_DFL)

if TYPE_CHECKING:
    from apex_lab.base.errors import UserError
    from apex_lab.inference.segmenter import Segmenter
    from apex_lab.prediction.load import load
    from apex_lab.scene import Scene

__all__ = ["Scene", "Segmenter", "UserError", "__version__", "load"]

_PLACES = {
    "Scene": "apex_lab.scene",
    "Segmenter": "apex_lab.inference.segmenter",
    "UserError": "apex_lab.base.errors",
    "load": "apex_lab.prediction.load",
}
"""Name -> where it lies. PyTorch is imported when the first of them is used."""


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])

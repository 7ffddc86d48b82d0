"""Which Python has TrackEval: this one, or one of its own, since its requirements do not go with ours.

TrackEval wants opencv-python, which takes the place of our opencv-python-headless. `make install` installs it without
its requirements (tests/no_deps.txt). Or make an environment of its own:
`python -m venv ENV && ENV/bin/pip install trackeval scikit-image` and `APEX_LAB_TRACKEVAL_PYTHON=ENV/bin/python`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

_HERE = sys.executable if importlib.util.find_spec("trackeval") and importlib.util.find_spec("skimage") else None
PYTHON = os.environ.get("APEX_LAB_TRACKEVAL_PYTHON", _HERE)

needs_trackeval = pytest.mark.skipif(PYTHON is None, reason="no TrackEval: pip install --no-deps -r tests/no_deps.txt")


def ask_trackeval(script: Path, question: object) -> Any:
    """What a script answers in JSON on the last line of its output, run with TrackEval's Python."""
    done = subprocess.run(
        [str(PYTHON), str(script)], input=json.dumps(question), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])

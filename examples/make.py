"""Makes pushing.mp4: a video of the project's own simulation that no shipped weights were trained on.

python examples/make.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from apex_lab.data import P2D
from apex_lab.view.encoder import Mp4

SETTINGS = "image_size=256 frames=24 train=1 val=1 test=6 seed=7"
VIDEO, FPS = 5, 8.0


def main() -> None:
    """Simulates six pushes, of which one becomes the file."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "sims.p2d", "--out", folder, "--set", *SETTINGS.split()], check=True)
        frames = P2D(folder, "test")[VIDEO]["video"].permute(0, 2, 3, 1).numpy()
    with Mp4(
        Path(__file__).with_name("pushing.mp4"), frames.shape[1:3], FPS, ("-crf", "18", "-preset", "slow")
    ) as movie:
        for frame in frames:
            movie.add(frame)


if __name__ == "__main__":
    main()

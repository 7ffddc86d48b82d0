"""Small videos and pictures, made by ffmpeg, OpenCV and Pillow."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest


def program() -> str:
    """ffmpeg; a test without it is skipped."""
    try:
        found = shutil.which(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        found = None
    if found is None:
        pytest.skip("there is no ffmpeg")
    return found


def moving(frames: int, height: int = 48, width: int = 64) -> np.ndarray:
    """(T, H, W, 3): a light square that moves right by a pixel a frame, its brightness says which frame it is."""
    video = np.full((frames, height, width, 3), 30, dtype=np.uint8)
    for t in range(frames):
        video[t, 8:24, t % (width - 16) : t % (width - 16) + 16] = (200 - 3 * (t % 40), 120, 60)
    return video


def encode(path: Path, video: np.ndarray, *options: str, fps: int = 10, before: tuple[str, ...] = ()) -> Path:
    """Writes RGB frames with ffmpeg; lossless unless the options say otherwise."""
    height, width = video.shape[1:3]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    command = [program(), "-v", "error", "-y", *before, *source, *(options or ("-c:v", "ffv1", "-pix_fmt", "bgr0"))]
    subprocess.run([*command, str(path)], input=video.tobytes(), check=True)
    return path

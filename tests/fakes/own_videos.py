"""Short videos of a square that moves over a plain ground, as files that OpenCV writes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def frame(video: int, number: int, height: int = 24, width: int = 32) -> np.ndarray:
    """RGB: a ground whose grey tells the frame, with a red square in the middle of it."""
    image = np.full((height, width, 3), 40 + 5 * number, np.uint8)
    row, column = height // 2 - 4, width // 2 - 4 + video % 3
    image[row : row + 8, column : column + 8] = (220, 30, 40)
    return image


def write_video(path: Path, video: int, frames: int, **size: int) -> Path:
    """One file; its format follows from its ending."""
    first = frame(video, 0, **size)
    code = cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), code, 10, first.shape[1::-1])
    for number in range(frames):
        writer.write(np.ascontiguousarray(frame(video, number, **size)[..., ::-1]))
    writer.release()
    return path


def write_pictures(folder: Path, video: int, frames: int, **size: int) -> Path:
    """A folder of PNGs, without loss."""
    folder.mkdir(parents=True)
    for number in range(frames):
        cv2.imwrite(str(folder / f"{number}.png"), frame(video, number, **size)[..., ::-1])
    return folder

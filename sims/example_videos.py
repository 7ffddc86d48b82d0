"""`python -m sims.example_videos --out FOLDER`: example "own videos": MP4 files of a scene that P2D does not have.

The camera stands on the other side of the table and higher, the table has a green cloth, and other objects lie on it.
The files look like those of a still camera: 4 : 3, 15 frames a second, compressed; there are no labels.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from recordings.progress import progress
from recordings.streams import say
from sims.background import background
from sims.camera import Camera
from sims.command import ending, path_argument
from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.settings_text import SettingsError, settings_from
from sims.p2d.simulate import simulate

CAMERA = Camera(eye=(1.22, 0.42, 0.72), target=(0.5, -0.03, 0.0), fov_deg=33.0)
OBJECTS = ("mug", "banana", "cracker_box", "orange", "foam_brick", "mustard_bottle")
CLOTH = np.array([0.42, 0.86, 0.72], dtype=np.float32)
"""What the wood's red, green and blue are multiplied by: a green cloth with the table's own shading and shadows."""
FRAMES_PER_S = 15
MOST = 10_000
"""Videos, and frames of a video."""

SCENE = Settings(min_objects=2, max_objects=3, objects=OBJECTS, camera=CAMERA, aim=0.8)


def main(arguments: list[str] | None = None) -> int:
    """Writes the videos that are missing; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sims.example_videos", description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=path_argument, required=True, help="folder for the MP4 files")
    parser.add_argument("--videos", type=int, default=20, help="how many (default: 20)")
    parser.add_argument("--frames", type=int, default=48, help="frames per video (default: 48)")
    parser.add_argument("--size", type=int, default=192, help="width in pixels (default: 192)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    return ending(lambda: _run(options), "finished videos are kept, run the same command to resume")


def _run(options: argparse.Namespace) -> int:
    if not 1 <= options.videos <= MOST or not 1 <= options.frames <= MOST:
        say(f"--videos {options.videos} --frames {options.frames}: give numbers from 1 to {MOST}", error=True)
        return 2
    try:
        settings = settings_from(
            [f"seed={options.seed}", f"frames={options.frames}", f"image_size={options.size}"], SCENE
        )
    except SettingsError as error:
        say(str(error), error=True)
        return 2
    write_videos(options.out, settings, options.videos)
    say(f"{options.out}: {options.videos} videos")
    return 0


def write_videos(out: Path, settings: Settings, videos: int) -> None:
    """Simulates and writes each video that is not there yet; a file has its final name when it is whole.

    Raises:
        SimError: PyBullet is missing, or the video cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SimError(f"{out} cannot be used as a folder ({error.strerror}): choose another") from error
    with progress("example videos", videos, "videos") as advance:
        for index in range(videos):
            path = out / f"push_{index:02d}.mp4"
            if not path.exists():
                draft = path.with_name(f".{path.name}")
                write_video(draft, frames(settings, index))
                draft.rename(path)
            advance(1)


def frames(settings: Settings, index: int) -> np.ndarray:
    """(T, H, W, 3) uint8 RGB, H = 3/4 W: one push, on the cloth."""
    trajectory = simulate(settings, "example", index)
    cloth = background(settings.camera, settings.image_size).table & (trajectory.segmentation == 0)
    rgb = np.where(cloth[..., None], trajectory.rgb * CLOTH, trajectory.rgb)
    height = settings.image_size * 3 // 4 // 2 * 2
    top = (settings.image_size - height) // 2
    return np.rint(rgb).astype(np.uint8)[:, top : top + height]


def write_video(path: Path, video: np.ndarray) -> None:
    """Writes (T, H, W, 3) uint8 RGB as MPEG-4.

    Raises:
        SimError: OpenCV cannot write there, or not all of it.
    """
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, video.shape[2:0:-1])
    if not writer.isOpened():
        raise SimError(f"{path} cannot be written: choose another folder")
    for frame in video:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    if (count := _frames_in(path)) != len(video):  # OpenCV says nothing of a full disk
        path.unlink(missing_ok=True)
        free = shutil.disk_usage(path.parent).free / 1e6
        raise SimError(
            f"{path} cannot be written ({count} of {len(video)} frames arrived; {free:.1f} MB free there): "
            "free some space and run the same command again"
        )


def _frames_in(path: Path) -> int:
    reader, count = cv2.VideoCapture(str(path)), 0
    while reader.read()[0]:
        count += 1
    reader.release()
    return count


if __name__ == "__main__":
    sys.exit(main())

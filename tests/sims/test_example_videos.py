"""Example "own videos": files that OpenCV reads, of another scene than P2D's; a second start makes what is missing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sims import example_videos


def test_videos_are_written_once_and_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    made: list[int] = []

    def frames(settings, index: int) -> np.ndarray:
        made.append(index)
        return np.full((settings.frames, 48, 64, 3), (20, 160, 90), np.uint8)

    monkeypatch.setattr(example_videos, "frames", frames)
    assert example_videos.main(["--out", str(tmp_path), "--videos", "2", "--frames", "5"]) == 0
    (tmp_path / "push_00.mp4").unlink()
    assert example_videos.main(["--out", str(tmp_path), "--videos", "2", "--frames", "5"]) == 0
    assert made == [0, 1, 0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["push_00.mp4", "push_01.mp4"]
    capture = cv2.VideoCapture(str(tmp_path / "push_00.mp4"))
    found, image = capture.read()
    assert found
    assert np.abs(image[..., ::-1].astype(int) - (20, 160, 90)).max() < 12
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 5
    (tmp_path / "file").touch()
    assert example_videos.main(["--out", str(tmp_path / "file"), "--videos", "1"]) == 1


@pytest.mark.slow
def test_the_table_is_green_and_the_frames_are_wide():
    pytest.importorskip("pybullet")
    from sims.p2d.settings import Settings

    settings = Settings(
        frames=2, image_size=64, min_objects=2, max_objects=3, objects=example_videos.OBJECTS,
        camera=example_videos.CAMERA, aim=0.8,
    )  # fmt: skip
    video = example_videos.frames(settings, 0)
    assert video.shape == (2, 48, 64, 3)
    corner = video[0, -8:, :8].reshape(-1, 3).mean(axis=0)
    assert corner[1] > 1.3 * corner[0]

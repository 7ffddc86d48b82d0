"""Movies decoded again: number of frames, format, colours."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.view import Item, encoder, movie
from apex_lab.view.canvas import GAP, MARGIN
from apex_lab.view.colors import BACKGROUND_COLOR, color_of
from apex_lab.view.encoder import Mp4
from apex_lab.view.movie import _CAPTION, _HEADING
from tests.view.scenes import FIRST, GREY, RED, H, T, W, item

SCALE = 7  # the smallest whole number that makes 24 pixels at least 160


def decode(path: Path) -> np.ndarray:
    """(F, h, w, 3)"""
    if path.suffix == ".mp4":
        return iio.imread(path)
    picture = Image.open(path)
    return np.stack([np.asarray(frame.convert("RGB")) for frame in iter_frames(picture)])


def iter_frames(picture: Image.Image):
    for i in range(picture.n_frames):
        picture.seek(i)
        yield picture


def at(frame: np.ndarray, column: int, y: int, x: int) -> np.ndarray:
    """Colour in the middle of pixel (y, x) of a panel of the first video."""
    top = MARGIN + _HEADING + _CAPTION + int((y + 0.5) * SCALE)
    left = MARGIN + column * (SCALE * W + GAP) + int((x + 0.5) * SCALE)
    return frame[top, left].astype(int)


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_frames_show_what_they_should(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"movie.{ending}"
    movie(path, [item()])
    frames = decode(path)
    assert len(frames) == T
    assert frames.shape[1] % 2 == frames.shape[2] % 2 == 0
    tolerance = 12 if ending == "mp4" else 4  # colours are halved in resolution and rounded, or taken from a palette
    for t in range(T):
        for column, color in enumerate((RED, RED, color_of(FIRST), color_of(1))):
            np.testing.assert_allclose(at(frames[t], column, 4, 4 + t), color, atol=tolerance)
        for column, color in enumerate((GREY, GREY, BACKGROUND_COLOR, BACKGROUND_COLOR)):
            np.testing.assert_allclose(at(frames[t], column, 0, 0), color, atol=tolerance)


def test_mp4_plays_in_browsers(tmp_path: Path) -> None:
    movie(tmp_path / "movie.mp4", [item()], fps=4.0)
    told = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(tmp_path / "movie.mp4")],
        capture_output=True,
        text=True,
    ).stderr
    assert "h264" in told
    assert "yuv420p" in told
    assert "4 fps" in told
    content = (tmp_path / "movie.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "the index stands in front"


def test_gif_loops_at_its_speed_and_keeps_still_frames(tmp_path: Path) -> None:
    name, video, said, b, truth = item()
    still = {
        f: getattr(said, f)[:, :1].repeat(1, T, *[1] * (getattr(said, f).ndim - 2))
        for f in ("masks", "ids", "presence", "reconstruction")
    }
    movie(
        tmp_path / "movie.gif",
        [
            Item(
                name,
                video[:, :1].repeat(1, T, 1, 1, 1),
                dataclasses.replace(said, **still),
                b,
                truth[:, :1].repeat(1, T, 1, 1),
            )
        ],
        fps=4.0,
    )
    picture = Image.open(tmp_path / "movie.gif")
    assert picture.n_frames == T
    assert picture.info["loop"] == 0
    assert picture.info["duration"] == 250


def test_shorter_videos_wait_and_many_videos_take_turns(tmp_path: Path) -> None:
    _, video, said, b, truth = item()
    cut = {
        f: getattr(said, f)[:, :2]
        for f in ("masks", "ids", "presence", "appearance", "reconstruction", "windows", "means")
    }
    short = Item("short", video[:, :2], dataclasses.replace(said, **cut), b, truth[:, :2])
    movie(tmp_path / "pair.mp4", [short, item("long")])
    frames = decode(tmp_path / "pair.mp4")
    assert len(frames) == T
    np.testing.assert_allclose(at(frames[T - 1], 0, 4, 5), RED, atol=12)  # where the square was in its last frame
    movie(tmp_path / "four.mp4", [item(str(i)) for i in range(4)])  # two pages of two
    assert len(decode(tmp_path / "four.mp4")) == 2 * T
    assert decode(tmp_path / "four.mp4").shape[1:] == frames.shape[1:]


def test_without_ground_truth_there_is_no_column_for_it(tmp_path: Path) -> None:
    movie(tmp_path / "with.gif", [item()])
    movie(tmp_path / "without.gif", [item(truth=False)])
    assert Image.open(tmp_path / "with.gif").width - Image.open(tmp_path / "without.gif").width == SCALE * W + GAP
    with pytest.raises(ValueError, match="partly with and partly without segmentation"):
        movie(tmp_path / "mixed.gif", [item(), item(truth=False)])


def test_other_endings_and_no_video_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.mp4 or \.gif"):
        movie(tmp_path / "movie.avi", [item()])
    with pytest.raises(ValueError, match="items is empty"):
        movie(tmp_path / "movie.mp4", [])


def test_a_system_without_ffmpeg_is_told_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "no_ffmpeg"))
    with pytest.raises(UserError, match=r"no_ffmpeg is no program.*IMAGEIO_FFMPEG_EXE"):
        movie(tmp_path / "movie.mp4", [item()])
    assert not list(tmp_path.iterdir())


def test_noise_survives_compression(tmp_path: Path) -> None:
    """A movie must look like its panels, not like mush: mean error of the MP4 under 3 % on random pictures."""
    name, video, said, b, truth = item()
    noise = torch.randint(0, 255, video.shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    movie(tmp_path / "movie.mp4", [Item(name, noise, said, b, truth)])
    frames = decode(tmp_path / "movie.mp4")
    wanted = noise[0].permute(0, 2, 3, 1).float().mean(-1).numpy()
    shown = np.stack([[[at(frame, 0, y, x).mean() for x in range(W)] for y in range(H)] for frame in frames])
    assert np.abs(shown - wanted).mean() < 0.03 * 255


def test_a_full_disk_is_one_sentence_without_words_of_ffmpeg(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "movie.mp4").symlink_to("/dev/full")
    with pytest.raises(UserError, match=r"movie\.mp4 cannot be written: ffmpeg (wrote|ended)"):
        write_noise(tmp_path / "movie.mp4")
    monkeypatch.setattr(encoder, "TIGHT", 2**60)
    with pytest.raises(UserError, match=r"No space left for .*movie\.mp4"):
        write_noise(tmp_path / "movie.mp4")
    assert capfd.readouterr() == ("", "")


def write_noise(path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (60, 128, 128, 3), dtype=np.uint8)
    with Mp4(path, (128, 128), fps=10.0) as film:
        for frame in frames:
            film.add(frame)

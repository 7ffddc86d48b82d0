"""Every kind of video that people have, and what is said of those that cannot be read."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.videos import find_videos, open_video, reader
from apex_lab.videos.reader import Camera
from tests.videos.made import encode, moving, program


def images(path: Path | str, start: int = 0) -> np.ndarray:
    return np.stack([frame.image for frame in open_video(path).frames(start)])


def test_frames_come_back_as_they_were_written(tmp_path: Path) -> None:
    made = moving(7)
    path = encode(tmp_path / "clip.mkv", made)
    video = open_video(path)
    assert (video.name, video.size, video.fps, video.announced, video.live) == ("clip", (48, 64), 10.0, 7, False)
    assert np.array_equal(images(path), made)
    assert np.array_equal(images(path, 5), made[5:])
    assert images(path, 0).dtype == np.uint8
    assert list(video.frames(7)) == []
    assert [frame.time for frame in video.frames()] == pytest.approx([0.1 * t for t in range(7)], abs=1e-6)


def test_too_little_memory_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV would give the frame before once more."""
    path = encode(tmp_path / "clip.mkv", moving(3))
    frames = open_video(path).frames()
    next(frames)
    monkeypatch.setattr(reader, "SPARE_BYTES", 2**62)
    with pytest.raises(MemoryError):
        next(frames)
    with pytest.raises(MemoryError):
        open_video(path)


@pytest.mark.parametrize("size", [(47, 63), (1, 1), (2160, 3840)])
def test_odd_tiny_and_large_sizes(tmp_path: Path, size: tuple[int, int]) -> None:
    made = np.random.default_rng(0).integers(0, 255, (2, *size, 3), dtype=np.uint8)
    path = encode(tmp_path / "clip.mkv", made)
    assert open_video(path).size == size
    assert np.array_equal(images(path), made)


def test_one_frame(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mkv", moving(1))
    assert np.array_equal(images(path), moving(1))


def test_rotation_in_the_metadata_is_applied(tmp_path: Path) -> None:
    made = moving(3)
    upright = encode(tmp_path / "upright.mp4", made, "-c:v", "libx264rgb", "-crf", "0")
    turned = tmp_path / "turned.mp4"
    command = [program(), "-v", "error", "-display_rotation", "90", "-i", str(upright), "-c", "copy", str(turned)]
    subprocess.run(command, check=True)
    assert open_video(turned).size == (64, 48)
    assert np.array_equal(images(turned), np.rot90(made, 1, axes=(1, 2)))


def test_a_variable_frame_rate_keeps_every_frame_and_its_time(tmp_path: Path) -> None:
    slower = "setpts='(N+gte(N,5)*(N-4)*2)/(10*TB)'"  # from frame 5 on, 0.3 s apart
    path = encode(
        tmp_path / "clip.mkv", moving(8), "-vf", slower, "-fps_mode", "vfr", "-c:v", "ffv1", "-pix_fmt", "bgr0"
    )
    frames = list(open_video(path).frames())
    assert np.array_equal(np.stack([frame.image for frame in frames]), moving(8))
    times = [0, 0.1, 0.2, 0.3, 0.4, 0.7, 1.0, 1.3]
    assert [frame.time for frame in frames] == pytest.approx(times, abs=2e-3)
    assert [frame.time for frame in open_video(path).frames(5)] == pytest.approx(times[5:], abs=2e-3)


@pytest.mark.parametrize("pixels", ["gray", "gray16le", "rgb48le", "bgra"])
def test_grey_deep_and_transparent_videos(tmp_path: Path, pixels: str) -> None:
    path = encode(tmp_path / "clip.mkv", moving(3), "-c:v", "ffv1", "-pix_fmt", pixels)
    found = images(path).astype(int)
    wanted = moving(3).astype(int)
    if pixels.startswith("gray"):
        assert np.array_equal(found[..., 0], found[..., 2])
        wanted = (wanted @ [0.299, 0.587, 0.114])[..., None].round()
    assert np.abs(found - wanted).max() <= 2


def test_the_content_counts_and_not_the_ending(tmp_path: Path) -> None:
    film = encode(tmp_path / "film.mkv", moving(3))
    picture = tmp_path / "picture.mp4"
    Image.fromarray(moving(1)[0]).save(picture, format="PNG")
    shutil.copy(film, tmp_path / "film.png")
    assert np.array_equal(images(tmp_path / "film.png"), moving(3))
    assert np.array_equal(images(picture), moving(1))


def test_a_cut_off_video_ends_early_and_its_claim_is_kept(tmp_path: Path) -> None:
    made = np.random.default_rng(0).integers(0, 255, (30, 48, 64, 3), dtype=np.uint8)
    path = encode(tmp_path / "clip.avi", made, "-c:v", "ffv1", "-pix_fmt", "bgr0", "-write_index", "0")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    video = open_video(path)
    found = images(path)
    assert 5 < len(found) < 30
    assert np.array_equal(found, made[: len(found)])
    assert video.announced is None or video.announced >= len(found)


def test_a_video_is_cut_off_where_its_times_end_before_what_it_announces(tmp_path: Path) -> None:
    lossless, slower = ("-c:v", "ffv1", "-pix_fmt", "bgr0"), "setpts='(N+gte(N,5)*(N-4)*2)/(10*TB)'"
    for name in ("variable.mkv", "variable.avi"):
        video = open_video(encode(tmp_path / name, moving(20), "-vf", slower, "-fps_mode", "vfr", *lossless))
        frames = list(video.frames())
        assert (len(frames), video.announced) == (20, 50)  # 5 seconds at the first frames' rate
        assert video.cut_off(20, frames[-1].time) is None
        assert video.cut_off(15, frames[14].time) == (
            "it announces 50 frames, and 15 could be read: it may be cut off or damaged "
            "(a trimmed video and longer sound announce too many, too)"
        )
    even = open_video(encode(tmp_path / "even.mkv", moving(20)))
    assert even.cut_off(20, 1.9) is None
    assert even.cut_off(19, 1.8) is None  # sound that is a little longer
    assert even.cut_off(15, 1.4) is not None


def test_what_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("hello\n")
    (tmp_path / "folder").mkdir()
    whole = encode(tmp_path / "whole.mp4", moving(3), "-c:v", "libx264", "-pix_fmt", "yuv420p")
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[:300])
    said = {
        "empty.mp4": "empty.mp4 is empty (0 bytes): copy it again.",
        "text.mp4": "text.mp4 is no video that can be read, or it holds no frame.",
        "cut.mp4": "cut.mp4 is no video that can be read, or it holds no frame.",
        "folder": "folder is a folder without pictures: give a video file or a folder of pictures.",
    }
    for name, words in said.items():
        with pytest.raises(UserError) as caught:
            open_video(tmp_path / name)
        assert str(caught.value) == f"{tmp_path}/{words}"
    with pytest.raises(UserError, match="There is no video at"):
        open_video(tmp_path / "missing.mp4")


def test_nothing_is_printed_about_a_damaged_file(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mp4").write_text("hello\n")
    with pytest.raises(UserError):
        open_video(tmp_path / "text.mp4")
    with pytest.raises(UserError, match="Camera 97 gives no picture"):
        open_video(97)
    assert capfd.readouterr() == ("", "")


def test_a_folder_of_pictures_is_a_video_in_natural_order(tmp_path: Path) -> None:
    made = moving(12)
    for t in range(12):
        Image.fromarray(made[t]).save(tmp_path / f"frame_{t}.png")
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / ".hidden.png").write_text("no picture")
    video = open_video(tmp_path)
    assert (video.size, video.announced, video.fps) == ((48, 64), 12, None)
    assert np.array_equal(images(tmp_path), made)
    assert np.array_equal(images(tmp_path, 10), made[10:])


def test_a_damaged_picture_and_one_of_another_size_are_named(tmp_path: Path) -> None:
    for t in range(3):
        Image.fromarray(moving(3)[t]).save(tmp_path / f"{t}.png")
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:80])
    with pytest.raises(UserError, match=r"/1\.png is"):
        images(tmp_path)
    Image.fromarray(moving(1, 50, 60)[0]).save(tmp_path / "1.png")
    with pytest.raises(UserError, match=r"/1\.png is 60 x 50 pixels, the first frame 64 x 48"):
        images(tmp_path)


def test_pictures_of_all_kinds_become_rgb_of_8_bits(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    grey = rgb[..., 0]
    deep = rgb.astype(np.uint16) * 256 + 77
    alpha = np.array([[0, 255, 128, 255] * 2] * 6, dtype=np.uint8)
    over_black = (rgb * (alpha[..., None] / 255)).round()
    cases = {
        "grey": (grey[..., None], lambda path: cv2.imwrite(path, grey)),
        "grey16": (grey[..., None], lambda path: cv2.imwrite(path, deep[..., 0])),
        "deep": (rgb, lambda path: cv2.imwrite(path, deep[..., ::-1])),
        "transparent": (over_black, lambda path: Image.fromarray(np.dstack([rgb, alpha])).save(path)),
        "palette": (grey[..., None] // 16 * 16, lambda path: Image.fromarray(grey // 16 * 16).convert("P").save(path)),
        "bits": ((grey[..., None] > 127) * 255, lambda path: Image.fromarray(grey > 127).save(path)),
    }
    for name, (wanted, write) in cases.items():
        path = str(tmp_path / f"{name}.png")
        write(path)
        found = images(path)[0]
        assert found.shape == (6, 8, 3), name
        assert np.abs(found.astype(int) - wanted.astype(int)).max() <= 1, name
    cv2.imwrite(str(tmp_path / "real.tiff"), grey.astype(np.float32))
    with pytest.raises(UserError, match=r"real\.tiff holds floating point numbers: save it as"):
        open_video(tmp_path / "real.tiff")


def test_exif_rotation_is_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: rotate by 90 degrees clockwise to see it upright
    Image.fromarray(moving(1)[0]).save(tmp_path / "turned.png", exif=exif)
    assert np.array_equal(images(tmp_path / "turned.png")[0], np.rot90(moving(1)[0], -1))


def test_an_animation_and_a_stack_are_videos(tmp_path: Path) -> None:
    made = [Image.fromarray(frame) for frame in moving(4)]
    made[0].save(tmp_path / "a.png", save_all=True, append_images=made[1:], duration=200)
    made[0].save(tmp_path / "a.tiff", save_all=True, append_images=made[1:])
    for name in ("a.png", "a.tiff"):
        assert np.array_equal(images(tmp_path / name), moving(4)), name
        assert np.array_equal(images(tmp_path / name, 2), moving(4)[2:]), name
    assert open_video(tmp_path / "a.png").fps == 5.0
    assert [frame.time for frame in open_video(tmp_path / "a.png").frames()] == pytest.approx([0, 0.2, 0.4, 0.6])


def test_what_is_meant_by_folders_and_patterns(tmp_path: Path) -> None:
    for name in ("clip_10.mp4", "clip_2.mp4", "notes.txt", "cover.jpg"):
        (tmp_path / name).write_text("x")
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "1.png").write_text("x")
    (tmp_path / "other").mkdir()
    folder, clips = tmp_path, [tmp_path / "clip_2.mp4", tmp_path / "clip_10.mp4"]
    assert find_videos(str(folder)) == [*clips, folder / "frames"]
    assert find_videos(str(folder / "frames")) == [folder / "frames"]
    assert find_videos(f"{folder}/clip_*.mp4") == clips
    assert find_videos([str(clips[1]), f"{folder}/*.mp4", "0"]) == [clips[1], clips[0], 0]
    for nothing in ("", " ", [str(clips[0]), ""]):
        with pytest.raises(UserError, match=r"^video = ' ?' is wrong: it is empty, as an unset variable is"):
            find_videos(nothing)
    with pytest.raises(UserError, match=r"other is a folder without videos or pictures"):
        find_videos(str(folder / "other"))
    with pytest.raises(UserError, match=r"missing\.mp4 does not exist: give a file"):
        find_videos(str(folder / "missing.mp4"))
    with pytest.raises(UserError, match=r"\*\.avi fits nothing"):
        find_videos(f"{folder}/*.avi")


def test_the_stamp_changes_with_the_file(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mkv", moving(2))
    before = open_video(path).stamp()
    assert open_video(path).stamp() == before
    encode(path, moving(3))
    assert open_video(path).stamp() != before


class _Capture:
    """Stands for a camera of two frames."""

    def __init__(self, number: int) -> None:
        self.left, self.released = (2 if number == 0 else 0), False

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.left -= 1
        return (True, np.full((4, 6, 3), (1, 2, 3), np.uint8)) if self.left >= 0 else (False, None)

    def get(self, key: int) -> float:
        return 30.0

    def release(self) -> None:
        self.released = True


def test_a_camera_is_read_once_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", _Capture)
    camera = open_video("0")
    assert isinstance(camera, Camera)
    assert (camera.name, camera.size, camera.fps, camera.announced, camera.live) == ("camera_0", (4, 6), 30, None, True)
    frames = list(camera.frames())
    assert [frame.image[0, 0].tolist() for frame in frames] == [[3, 2, 1]] * 2
    assert getattr(camera._capture, "released", False)
    with pytest.raises(UserError, match="Camera 0 can be read once"):
        next(camera.frames())
    with pytest.raises(UserError, match="Camera 1 gives no picture: check that it is connected"):
        open_video(1)

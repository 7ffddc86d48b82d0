"""`python -m apex_lab.predict`: what it writes, how it stops and resumes, what it refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from pycocotools import mask as coco

from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted
from apex_lab.inference.segmenter import Segmenter
from apex_lab.prediction import work
from apex_lab.prediction.journal import Journal
from apex_lab.prediction.objects import Predicted, Reader
from apex_lab.prediction.work import Wanted, predict_video, unique_names
from apex_lab.videos import Frame, Video, open_video
from apex_lab.videos.reader import VideoFile
from tests.conftest import REPOSITORY, Ended
from tests.prediction.lamps import WEIGHTS, Lamps, Patient, Strangers, segmenter
from tests.videos.made import encode, moving

EXAMPLE = REPOSITORY / "examples" / "pushing.mp4"
ALL = Wanted(chunk=4, save_interval=8)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A video of 21 frames."""
    return encode(tmp_path / "clip.mkv", moving(21))


def run(clip: Path, folder: Path, wanted: Wanted = ALL, made: Segmenter | None = None, again: bool = False) -> Path:
    return predict_video(made or segmenter(), WEIGHTS, wanted, clip, folder, clip.stem, again)


def content(folder: Path) -> dict[str, bytes]:
    """The files of a result; movies by their size alone, since parts that are cut elsewhere are encoded otherwise."""
    found = {}
    for file in sorted(folder.rglob("*.*")):
        name = str(file.relative_to(folder))
        if file.suffix == ".mp4":
            found[name] = repr(film(folder).shape).encode()
        else:
            found[name] = file.read_bytes()
    return found


def film(folder: Path) -> np.ndarray:
    """The frames of a result's overlay."""
    return np.stack([frame.image for frame in open_video(folder / "overlay.mp4").frames()]).astype(int)


def test_all_files_say_the_same(clip: Path, tmp_path: Path) -> None:
    one = run(clip, tmp_path / "one")
    two = run(clip, tmp_path / "two", Wanted(masks="rle", table="parquet", chunk=5, save_interval=10))
    assert sorted(each.name for each in one.iterdir()) == [
        *("info.json", "masks", "objects.csv", "overlay.mp4", "tracks.txt"),
    ]
    assert sorted(each.name for each in two.iterdir()) == [
        *("info.json", "masks.json", "objects.parquet", "overlay.mp4", "tracks.txt"),
    ]
    table, arrow = pd.read_csv(one / "objects.csv"), pd.read_parquet(two / "objects.parquet")
    assert len(table) == len(arrow) == 21 + 4  # 21 frames; from frame 17 on the square reaches into the right half
    pd.testing.assert_frame_equal(table[list(arrow.columns[:-1])], arrow[list(arrow.columns[:-1])])
    assert np.array_equal(table[["appearance_0", "appearance_1"]], np.stack(arrow["appearance"].to_numpy()))
    assert table["appearance_0"].tolist() == table["frame"].tolist()
    masks = json.loads((two / "masks.json").read_text())
    rows = [[int(word) for word in line.split(",")[:6]] for line in (one / "tracks.txt").read_text().splitlines()]
    assert (one / "tracks.txt").read_bytes() == (two / "tracks.txt").read_bytes()
    for row, mask, track in zip(table.itertuples(), masks, rows, strict=True):
        image = Image.open(one / "masks" / f"{row.frame:06d}.png")
        assert image.mode == "P"
        pixels = np.asarray(image) == row.mask_index
        assert np.array_equal(coco.decode(mask["segmentation"]), pixels)
        assert (mask["image_id"], mask["track_id"]) == (row.frame, row.id)
        ys, xs = np.nonzero(pixels)
        assert (row.left, row.top) == (xs.min(), ys.min())
        assert (row.width, row.height) == (np.ptp(xs) + 1, np.ptp(ys) + 1)
        assert (row.x, row.y, row.area) == pytest.approx((xs.mean(), ys.mean(), len(xs)), abs=1e-3)
        assert track == [row.frame + 1, row.id, row.left + 1, row.top + 1, row.width, row.height]
        assert row.time == pytest.approx(row.frame / 10, abs=1e-3)
    info = json.loads((one / "info.json").read_text())
    assert info["frames"] == 21
    assert info["objects"] == 2
    assert info["framing"]["seen_part_of_frame"] == {"top": 0, "left": 8, "height": 48, "width": 48}
    movie = open_video(one / "overlay.mp4")
    assert (movie.size, movie.announced, movie.fps) == ((48, 64), 21, 10.0)


def test_the_overlay_shows_the_objects_and_darkens_what_was_not_seen(clip: Path, tmp_path: Path) -> None:
    frame = next(open_video(run(clip, tmp_path / "out") / "overlay.mp4").frames(4)).image.astype(int)
    assert frame[40, 30].tolist() == pytest.approx([30, 30, 30], abs=12)
    assert frame[40, 3].tolist() == pytest.approx([10, 10, 10], abs=12)
    paint = np.array([0xE6, 0x9F, 0x00])  # of the identity 1
    assert np.abs(frame[16, 14] - (0.55 * moving(5)[4, 16, 14] + 0.45 * paint)).max() < 30


def test_every_and_frames_choose(clip: Path, tmp_path: Path) -> None:
    folder = run(clip, tmp_path / "out", Wanted(every=3, frames=5, overlay=False, table=None, tracks=False))
    names = [path.name for path in sorted((folder / "masks").iterdir())]
    assert names == [f"{t:06d}.png" for t in (0, 3, 6, 9, 12)]
    assert json.loads((folder / "info.json").read_text())["notes"] == []


def test_an_object_without_pixels_has_a_row_without_a_box(tmp_path: Path) -> None:
    from apex_lab.prediction.objects import Seen
    from apex_lab.prediction.outputs import CsvTable, Tracks

    frame = Frame(np.zeros((4, 4, 3), np.uint8), 0.5)
    hidden = Predicted(
        3, frame, np.zeros((4, 4), np.uint8), [Seen(2, 2, 0.75, 0, None, None)], np.ones((1, 1), np.float32)
    )
    for output in (CsvTable(False), Tracks()):
        with output.part(tmp_path) as add:
            add(hidden)
    [row] = csv.DictReader((tmp_path / "objects.csv").read_text().splitlines())
    assert (row["frame"], row["id"], row["left"], row["x"], row["area"], row["presence"]) == (
        "3",
        "2",
        "",
        "",
        "0",
        "0.75",
    )
    assert (tmp_path / "tracks.txt").read_text() == ""


class Broken(Exception):
    """In place of a kill: nothing in the program handles it."""


def breaking(monkeypatch: pytest.MonkeyPatch, at: int, act: Callable[[], None]) -> None:
    """Lets `act` happen when frame `at` is read out of its scene."""
    read = Reader.__call__

    def call(self: Reader, scene: object, t: int, number: int, frame: Frame) -> Predicted:
        if number == at:
            act()
        return read(self, scene, t, number, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(Reader, "__call__", call)


def kill() -> None:
    raise Broken


def stopped(
    monkeypatch: pytest.MonkeyPatch,
    at: int,
    act: Callable[[], None],
    clip: Path,
    folder: Path,
    made: Segmenter | None = None,
) -> None:
    """Predicts until frame `at`, where `act` ends it."""
    with monkeypatch.context() as patched:
        breaking(patched, at, act)
        with pytest.raises((Broken, Interrupted)):
            run(clip, folder, made=made)


@pytest.mark.parametrize("model", [Lamps, Strangers, Patient])
def test_after_a_kill_the_same_request_resumes_and_ends_alike(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: type[Lamps]
) -> None:
    unbroken = content(run(clip, tmp_path / "unbroken", made=segmenter(model())))
    seen: list[int] = []
    for at in (10, 20):
        stopped(monkeypatch, at, kill, clip, tmp_path / "out", segmenter(model()))
        assert [each.name for each in (tmp_path / "out").iterdir()] == [".clip.part"]  # nothing under its final name
    breaking(monkeypatch, 16, lambda: seen.append(16))
    breaking(monkeypatch, 15, lambda: seen.append(15))
    folder = run(clip, tmp_path / "out", made=segmenter(model()))
    assert seen == [16]  # two parts of 8 frames were done
    assert content(folder) == unbroken
    assert [each.name for each in (tmp_path / "out").iterdir()] == ["clip"]


def test_again_starts_at_the_first_frame(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped(monkeypatch, 10, kill, clip, tmp_path / "out")
    seen: list[int] = []
    breaking(monkeypatch, 0, lambda: seen.append(0))
    run(clip, tmp_path / "out", again=True)
    assert seen == [0]


@pytest.mark.parametrize("damage", ["journal", "part", "state", "picture"])
def test_a_damaged_journal_starts_the_video_again(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    unbroken = content(run(clip, tmp_path / "unbroken"))
    stopped(monkeypatch, 10, kill, clip, tmp_path / "out")
    place = tmp_path / "out" / ".clip.part"
    file = {
        "journal": place / "journal.json",
        "part": place / "parts" / "00000" / "tracks.txt",
        "state": place / "state_00001.pt",
        "picture": place / "results" / "masks" / "000003.png",
    }[damage]
    file.write_bytes(b"" if damage == "picture" else file.read_bytes()[:-5])
    assert content(run(clip, tmp_path / "out")) == unbroken


@pytest.mark.parametrize("at", [1, 10, 20])
def test_a_request_to_stop_stores_what_was_done(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    unbroken = run(clip, tmp_path / "unbroken")
    stopped(monkeypatch, at, lambda: os.kill(os.getpid(), signal.SIGTERM), clip, tmp_path / "out")
    if at < 20:
        stored = Journal(tmp_path / "out" / ".clip.part", "").folder / "journal.json"
        assert json.loads(stored.read_text())["done"] == at // 4 * 4 + 4  # the chunk at hand was finished
    folder = run(clip, tmp_path / "out")
    assert content(folder) == content(unbroken)
    assert np.abs(film(folder) - film(unbroken)).mean() < 1.5


def test_what_was_done_is_not_repeated_and_other_requests_do_not_replace_it(clip: Path, tmp_path: Path) -> None:
    folder = run(clip, tmp_path / "out")
    before = (folder / "info.json").stat().st_mtime_ns
    run(clip, tmp_path / "out")
    assert (folder / "info.json").stat().st_mtime_ns == before
    other = Wanted(masks="rle")
    with pytest.raises(UserError, match="holds results of another checkpoint, video or other settings: add again=true"):
        run(clip, tmp_path / "out", other)
    run(clip, tmp_path / "out", other, again=True)
    assert not (folder / "masks").exists()
    assert (folder / "masks.json").is_file()
    (tmp_path / "mine" / "clip").mkdir(parents=True)
    with pytest.raises(UserError, match="was not made by this command: give another folder="):
        run(clip, tmp_path / "mine")


def test_models_that_do_not_track_or_stream_say_so(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = json.loads((run(clip, tmp_path / "a", made=segmenter(Strangers())) / "info.json").read_text())
    assert info["identities"] == "linked"
    assert info["notes"] == ["Strangers does not track: objects are linked by the overlap of their masks"]
    patient = run(clip, tmp_path / "b", made=segmenter(Patient()))
    assert (patient / "tracks.txt").read_bytes() == (run(clip, tmp_path / "c") / "tracks.txt").read_bytes()
    monkeypatch.setattr(work, "MOST_AT_ONCE", 20)
    with pytest.raises(UserError, match=r"Patient needs the whole video at once, and .* has more than 20 frames: give"):
        run(clip, tmp_path / "d", made=segmenter(Patient()))


def test_a_video_that_ends_before_its_claim_is_told(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = VideoFile.frames

    def cut(self: VideoFile, start: int = 0) -> Iterator[Frame]:
        yield from [frame for number, frame in enumerate(whole(self)) if start <= number < 9]

    monkeypatch.setattr(VideoFile, "frames", cut)
    info = json.loads((run(clip, tmp_path / "out") / "info.json").read_text())
    [note] = info["notes"]
    assert note.startswith("it announces 21 frames, and 9 could be read: it may be cut off")


@pytest.mark.parametrize("every", [1, 4])
def test_the_overlay_of_a_video_of_a_variable_rate_lasts_as_long_as_the_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    slower = ("-vf", "setpts='(N+gte(N,5)*(N-4)*2)/(10*TB)'", "-fps_mode", "vfr")  # 20 frames in 4.9 seconds
    clip = encode(tmp_path / "clip.mkv", moving(20), *slower, "-c:v", "ffv1", "-pix_fmt", "bgr0")
    wanted = Wanted(chunk=2, save_interval=2, every=every)
    with monkeypatch.context() as patched:
        breaking(patched, 12, kill)
        with pytest.raises(Broken):
            run(clip, tmp_path / "out", wanted)
    folder = run(clip, tmp_path / "out", wanted)  # resumed: the rate is that of all frames
    frames = list(open_video(folder / "overlay.mp4").frames())
    assert len(frames) == 20 / every
    assert frames[-1].time == pytest.approx({1: 4.9, 4: 4.0}[every], abs=0.05)
    assert json.loads((folder / "info.json").read_text())["notes"] == []


@pytest.mark.parametrize("content", ["[]", "{}", '"text"', '{"key": 1}', "the key alone", "other types"])
def test_a_journal_of_another_content_starts_the_video_again(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str
) -> None:
    stopped(monkeypatch, 10, kill, clip, tmp_path / "out")
    file = tmp_path / "out" / ".clip.part" / "journal.json"
    before = json.loads(file.read_text())
    if content == "the key alone":
        content = json.dumps({"key": before["key"]})
    elif content == "other types":
        content = json.dumps({**before, "parts": 3})
    file.write_text(content)
    assert json.loads((run(clip, tmp_path / "out") / "info.json").read_text())["frames"] == 21


class _Camera(Video):
    source, name, size, fps, live = 0, "camera_0", (48, 64), 10.0, True

    def frames(self, start: int = 0) -> Iterator[Frame]:
        for t in range(10**6):
            if t == 10:
                os.kill(os.getpid(), signal.SIGINT)
            yield Frame(moving(1)[0], t / 10)

    def stamp(self) -> str:
        return "0"


def test_ctrl_c_ends_a_camera_s_video_and_its_results_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "open_video", lambda source: _Camera())
    predict_video(segmenter(), WEIGHTS, Wanted(chunk=4), 0, tmp_path, "camera_0", False)  # success: exit code 0
    [folder] = tmp_path.glob("camera_0_*")
    assert json.loads((folder / "info.json").read_text())["frames"] == 12
    assert open_video(folder / "overlay.mp4").announced == 12
    assert [each.name for each in tmp_path.iterdir()] == [folder.name]


def test_videos_of_one_name_have_different_folders() -> None:
    names = unique_names([Path("a/x.mp4"), Path("b/x.mp4"), Path("b/y.mp4"), 0])
    assert names[Path("b/y.mp4")] == "y"
    assert names[0] == "camera_0"
    first, second = names[Path("a/x.mp4")], names[Path("b/x.mp4")]
    assert first != second
    assert all(len(name) == 10 and name.startswith("x_") for name in (first, second))


# --- the command ---


def test_a_video_that_fails_for_an_unforeseen_reason_does_not_stop_the_others(
    command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.mkv", "b.mkv"):
        encode(tmp_path / name, moving(2))
    whole = VideoFile.frames

    def broken(self: VideoFile, start: int = 0) -> Iterator[Frame]:
        if self.name == "a":
            raise ZeroDivisionError("of the decoder")
        return whole(self, start)

    monkeypatch.setattr(VideoFile, "frames", broken)
    ended = command("predict", *QUICK, "video=*.mkv")
    assert ended.code == 1
    assert "a.mkv: ZeroDivisionError: of the decoder (traceback: " in ended.err
    assert "Traceback" not in ended.err
    assert "1 of 2 videos were not predicted:" in ended.err
    assert (tmp_path / "out" / "b" / "info.json").is_file()


QUICK = ("checkpoint=apex-p2d-cpu", "overlay=false", "appearance=false", "accelerator=cpu", "frames=2", "folder=out")


def test_of_many_videos_the_bad_ones_are_named_and_the_others_done(
    command: Callable[..., Ended], tmp_path: Path
) -> None:
    clips = tmp_path / "my clips"
    clips.mkdir()
    encode(clips / "a=1, (2).mkv", moving(3))
    encode(clips / "b.mkv", moving(3))
    (clips / "bad.mkv").write_text("no video")
    ended = command("predict", *QUICK, f"video={clips}/*.mkv")
    assert ended.code == 1
    assert ended.err.splitlines() == [
        f"{clips}/bad.mkv is no video that can be read, or it holds no frame.",
        "1 of 3 videos were not predicted:",
        f"  {clips}/bad.mkv is no video that can be read, or it holds no frame.",
    ]
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == [".lock", "a=1, (2)", "b"]
    (clips / "bad.mkv").unlink()
    ended = command("predict", *QUICK, f"video={clips}")
    assert ended.code == 0
    assert ended.out.count("done before (again=true does it once more)") == 2


def test_wrong_commands_are_refused_in_one_sentence(command: Callable[..., Ended], tmp_path: Path) -> None:
    cases = {
        ("video=x.mp4",): "checkpoint is missing: write checkpoint=apex-p2d-cpu, or a .ckpt file or run folder.",
        ("checkpoint=apex-p2d-cpu",): "video is missing: write video=FILE, a folder of pictures, a pattern with * or a "
        "camera (0).",
        (
            "checkpoint=apex-p2d-cpu",
            "video=a,b (1)=[x].mp4",
        ): "video = a,b (1)=[x].mp4 fits nothing: give video files or folders of pictures.",
        (
            "checkpoint=none.ckpt",
            f"video={EXAMPLE}",
        ): "checkpoint = none.ckpt does not exist: give a .ckpt file or a run folder.",
        ("checkpoint=apex-p2d-cpu", f"video={EXAMPLE}", "maks=rle"): "Unknown key maks = 'rle'; did you mean 'masks'?",
        (
            "checkpoint=apex-p2d-cpu",
            "video=",
        ): "video = '' is wrong: it is empty, as an unset variable is: give a path.",
        (
            "checkpoint=apex-p2d-cpu",
            f"video={EXAMPLE}",
            "masks=gif",
        ): "masks = 'gif' is wrong: input should be 'png' or 'rle'.",
        (
            *("checkpoint=apex-p2d-cpu", f"video={EXAMPLE}"),
            *("overlay=false", "masks=null", "tracks=false", "table=null"),
        ): "overlay, masks, tracks and table are all switched off: leave one on.",
    }
    for words, said in cases.items():
        ended = command("predict", *words)
        assert (ended.code, ended.err) == (2, said + "\n"), words
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_another_process_works_on_is_busy(command: Callable[..., Ended], tmp_path: Path) -> None:
    from filelock import FileLock

    (tmp_path / "out").mkdir()
    with FileLock(str(tmp_path / "out" / ".lock")):
        ended = command("predict", *QUICK, f"video={EXAMPLE}")
    assert ended.code == 1
    assert ended.err == "out is being worked on by another process: wait for it, or give another folder=.\n"


@pytest.mark.slow
def test_the_example_in_the_readme(command: Callable[..., Ended], tmp_path: Path) -> None:
    ended = command("predict", "checkpoint=apex-p2d-cpu", f"video={EXAMPLE}")
    assert ended.code == 0
    [folder] = (tmp_path / "outputs" / "predict").glob("apex_p2d_cpu_*/pushing")
    table = pd.read_csv(folder / "objects.csv")
    assert (table.groupby("id")["frame"].nunique() == 24).sum() >= 4  # objects are kept through the whole video
    assert cv2.VideoCapture(str(folder / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 24

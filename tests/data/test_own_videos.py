"""Own videos: found, looked at once, cut into clips of known frames, split without overlap; bad ones named."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.base.errors import UserError
from apex_lab.data import OwnVideosSource
from apex_lab.data.own_videos import cutting, scan
from apex_lab.data.own_videos.__main__ import main as command_line
from apex_lab.data.own_videos.cutting import SPLITS, Cut
from apex_lab.data.own_videos.maker import Stream
from recordings import MANIFEST
from tests.conftest import REPOSITORY, Ended
from tests.fakes.own_videos import frame, write_pictures, write_video
from tests.videos.made import encode

SMALL = {"frames": 3, "image_size": 16, "train": 100, "val": 100, "test": 100, "prepare_workers": 0, "workers": 0}


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three folders of pictures with 9, 9 and 12 frames, and files that are no use."""
    root = tmp_path_factory.mktemp("videos")
    for video, frames in enumerate((9, 9, 12)):
        write_pictures(root / f"clip {video}", video, frames)
    write_pictures(root / "short", 5, 2)
    (root / "notes.txt").write_text("not a video")
    return root


@pytest.fixture(scope="module")
def data(videos: Path, tmp_path_factory: pytest.TempPathFactory) -> OwnVideosSource:
    source = OwnVideosSource(str(tmp_path_factory.mktemp("data")), str(videos), **SMALL)
    source.prepare()
    source.open()
    return source


def opened(root: Path, videos: Path | str, **changes: object) -> OwnVideosSource:
    source = OwnVideosSource(str(root), str(videos), **{**SMALL, **changes})
    source.prepare()
    source.open()
    return source


def numbers(video: np.ndarray) -> list[int]:
    """Which frames a clip shows, told by the grey of its ground."""
    return [int((grey - 40) // 5) for grey in video[:, 0, 0, 0]]


def test_clips_hold_the_frames_that_their_names_say(data: OwnVideosSource):
    found = {}
    for split in SPLITS:
        for item in data.sets[split]:
            first = int(item["name"][-6:])
            assert numbers(item["video"].numpy()) == [first, first + 1, first + 2]
            assert item["video"].shape == (3, 3, 16, 16)
            assert "segmentation" not in item
            found[item["name"]] = split
    assert sorted(found) == [
        f"clip_{video}_{start:06d}" for video in range(3) for start in range(0, 9 + 3 * (video == 2), 3)
    ]
    assert [list(found.values()).count(split) for split in SPLITS] == [8, 1, 1]
    assert not data.sets["train"].labelled


def test_frames_are_cropped_in_the_middle_or_shown_whole(tmp_path: Path, videos: Path, data: OwnVideosSource):
    middle = frame(0, 0)[:, 4:28]
    item = data.sets["train"][0]["video"][0].numpy()
    red = item[0].astype(int) - item[1]
    assert (red > 100).sum() / red.size == pytest.approx((middle[..., 0] == 220).mean(), abs=0.05)
    boxed = opened(tmp_path, videos, fit="letterbox").sets["train"][0]["video"][0].numpy()
    assert (boxed[:, :2] == 0).all()
    assert (boxed[:, -2:] == 0).all()
    assert (boxed[:, 2:-2] > 0).any(axis=0).all()


def test_stride_and_hop(tmp_path: Path, videos: Path):
    source = opened(tmp_path, videos, stride=2, hop=1, split_by="time")
    train = source.sets["train"]
    shown = [numbers(train[i]["video"].numpy()) for i in range(len(train))]
    assert all(each == [each[0], each[0] + 2, each[0] + 4] for each in shown)
    by_split = {
        split: {(n[:6], f) for i in range(len(s)) for n in [s.name(i)] for f in range(int(n[-6:]), int(n[-6:]) + 5)}
        for split, s in source.sets.items()
    }
    assert not by_split["train"] & by_split["val"]
    assert not by_split["val"] & by_split["test"]
    assert not by_split["train"] & by_split["test"]


def test_short_and_unreadable_videos_are_named_and_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    caplog.set_level("INFO", "apex_lab")
    root = tmp_path / "videos"
    root.mkdir()
    for video in range(3):
        write_video(root / f"good{video}.mp4", video, 6)
    (root / "empty.mp4").touch()
    (root / "broken.mkv").write_bytes(b"nothing" * 1000)
    write_video(root / "short.avi", 4, 2)
    (root / "copy.mp4").write_bytes((root / "good1.mp4").read_bytes())
    source = opened(tmp_path / "data", root)
    said = caplog.text
    assert "4 of 7 videos are skipped:" in said
    for sentence in (
        "empty.mp4 is empty (0 bytes)",
        "broken.mkv is no video that can be read",
        "short.avi is too short: it has 2 frames, a clip needs 3.",
        "good1.mp4 has the same content as",
    ):
        assert sentence in said
    assert "3 videos, clips split by time within each video: 4 train, 1 val, 1 test" in said
    facts = json.loads((source.folder / MANIFEST).read_text())
    assert [each["video"] for each in facts["skipped"]] == ["broken.mkv", "empty.mp4", "good1.mp4", "short.avi"]
    assert facts["source"] == str(root)


def test_videos_that_end_early_are_named_and_used(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    root = tmp_path / "videos"
    root.mkdir()
    for video in range(2):
        write_video(root / f"good{video}.mkv", video, 6)
    noise = np.random.default_rng(0).integers(0, 255, (30, 48, 64, 3), dtype=np.uint8)
    cut = encode(root / "cut.avi", noise, "-c:v", "ffv1", "-pix_fmt", "bgr0", "-write_index", "0")
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    for _ in range(2):  # also when what was found is known already
        caplog.clear()
        source = opened(tmp_path / "data", root)
        assert "1 of 3 videos end early and are used as far as they go:" in caplog.text
        assert f"{cut}: it announces 30 frames, and 1" in caplog.text
    assert len(source.manifest().settings["videos"]) == 3


def test_a_folder_without_usable_videos_is_one_sentence(tmp_path: Path, videos: Path):
    with pytest.raises(UserError, match=r"^data.path = .*/nowhere does not exist: give a folder of videos.$"):
        opened(tmp_path, tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    with pytest.raises(UserError, match="is a folder without videos or pictures"):
        opened(tmp_path, tmp_path / "bare")
    with pytest.raises(UserError, match=r"fits nothing"):
        opened(tmp_path, f"{tmp_path}/*.mp4")
    with pytest.raises(UserError, match=r"holds no usable video \(4 skipped: .* is too short: it has 9 frames"):
        opened(tmp_path, videos, frames=13)
    with pytest.raises(UserError, match=r"gives no clip for val and test \(1 videos, split by time\): add videos or"):
        opened(tmp_path, videos, frames=12)
    with pytest.raises(UserError, match=r"data=video needs videos: set data.path=FOLDER"):
        OwnVideosSource(str(tmp_path))
    with pytest.raises(UserError, match=r"data.val_share = 0.5 and data.test_share = 0.5 leave nothing for training"):
        OwnVideosSource(str(tmp_path), str(videos), val_share=0.5, test_share=0.5)


def test_videos_are_looked_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root = tmp_path / "videos"
    for video in range(3):
        write_pictures(root / str(video), video, 6)
    write_pictures(tmp_path / "later", 3, 7)
    looked: list[str] = []
    look = scan._look
    monkeypatch.setattr(scan, "_look", lambda path: looked.append(path.name) or look(path))
    first = opened(tmp_path / "data", root)
    assert sorted(looked) == ["0", "1", "2"]
    assert opened(tmp_path / "data", root).folder == first.folder
    assert len(looked) == 3
    os.utime(root / "1" / "3.png", (0, 0))  # touched, same content
    assert opened(tmp_path / "data", root).folder == first.folder
    assert looked[3:] == ["1"]
    (tmp_path / "later").rename(root / "3")
    more = opened(tmp_path / "data", root)
    assert looked[4:] == ["3"]
    assert more.folder != first.folder
    assert more.fingerprint != first.fingerprint
    for cache in (tmp_path / "data").glob(".own_videos_*"):
        cache.write_text('{"version": 1, "videos": {"x": 3}}')
    assert opened(tmp_path / "data", root).folder == more.folder


def test_moved_videos_keep_their_recording(tmp_path: Path, videos: Path, data: OwnVideosSource):
    (tmp_path / "elsewhere").symlink_to(videos)
    moved = OwnVideosSource(str(data.root), str(tmp_path / "elsewhere"), **SMALL)
    moved.prepare()
    assert moved.folder == data.folder


def test_a_finished_recording_needs_no_videos(tmp_path: Path, data: OwnVideosSource):
    again = opened(tmp_path, data.folder)
    assert again.fingerprint == data.fingerprint
    assert again.folder == data.folder
    assert again.sets["train"].name(0) == data.sets["train"].name(0)
    with pytest.raises(UserError, match=r"was made with stride = 1 and not 2: set data.stride=1."):
        opened(tmp_path, data.folder, stride=2)


def test_without_generate_missing_clips_are_refused_and_nothing_is_written(
    tmp_path: Path, videos: Path, data: OwnVideosSource
):
    with pytest.raises(UserError, match=r"^no finished own_videos data at .*: set data\.generate=true or run python"):
        opened(tmp_path, videos, generate=False)
    assert list(tmp_path.iterdir()) == []
    assert opened(data.root, videos, generate=False).folder == data.folder


def test_limits_take_evenly_spaced_clips(tmp_path: Path, videos: Path):
    source = opened(tmp_path, videos, train=3)
    assert [len(source.sets[split]) for split in SPLITS] == [3, 1, 1]


def test_repair_cuts_damaged_clips_again(tmp_path: Path, videos: Path, capsys: pytest.CaptureFixture[str]):
    source = opened(tmp_path, videos)
    path = source.folder / "train" / "rgb.npy"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(UserError, match=r"repair it with python -m apex_lab.data.own_videos verify .* --repair"):
        opened(tmp_path, videos)
    assert command_line(["verify", str(source.folder)]) == 1
    assert command_line(["verify", str(source.folder), "--repair", "--path", str(tmp_path / "gone")]) == 1
    assert "data.path = " in capsys.readouterr().err
    assert command_line(["verify", str(source.folder), "--repair", "--workers", "1"]) == 0
    assert path.read_bytes() == whole
    assert command_line(["verify", str(source.folder)]) == 0
    assert command_line(["verify", str(tmp_path), "--repair"]) == 1
    assert not (tmp_path / ".lock").exists()


def test_a_stream_reads_any_clip_in_any_order(tmp_path: Path):
    folder = write_pictures(tmp_path / "video", 0, 12)
    stream = Stream(folder, 16, "crop", 4)
    for start in (0, 2, 3, 8, 1, 0, 8):
        assert numbers(np.stack(stream.read(start, 4)).transpose(0, 3, 1, 2)) == list(range(start, start + 4))
    assert len(stream.read(10, 4)) == 2
    assert stream.read(30, 4) == []


def test_following_clips_are_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    stream = Stream(write_pictures(tmp_path / "video", 0, 12), 16, "crop", 4)
    monkeypatch.setattr(stream, "_open", lambda start: pytest.fail("opened again"))
    for start in (0, 2, 4, 8):
        stream.read(start, 4)


@given(
    lengths=st.lists(st.integers(0, 60), min_size=1, max_size=15),
    frames=st.integers(1, 6),
    stride=st.integers(1, 3),
    hop=st.integers(1, 12),
    by_video=st.booleans(),
)
def test_no_frame_is_in_two_splits(lengths: list[int], frames: int, stride: int, hop: int, by_video: bool):
    cut, shares = Cut(frames, stride, hop), {"val": 0.1, "test": 0.2}
    if by_video:
        clips = cutting.clips_by_video([str(i) for i in range(len(lengths))], lengths, cut, shares)
    else:
        clips = cutting.clips_by_time(lengths, cut, shares)
    used = {
        split: {(video, start + k) for video, start in each for k in range(cut.span)} for split, each in clips.items()
    }
    assert not used["train"] & used["val"]
    assert not used["train"] & used["test"]
    assert not used["val"] & used["test"]
    assert all(start + cut.span <= lengths[video] for each in clips.values() for video, start in each)
    if hop >= cut.span:  # no clip is lost
        assert sum(map(len, clips.values())) == sum(len(cut.starts(length)) for length in lengths)
    if not by_video and hop >= cut.span and sum(len(cut.starts(length)) for length in lengths) >= 3:
        assert all(clips.values())


def test_a_new_video_moves_few_others():
    digests = [f"{i:032x}" for i in range(40)]
    cut, shares = Cut(2, 1, 2), {"val": 0.1, "test": 0.1}
    before = cutting.clips_by_video(digests[:-1], [2] * 39, cut, shares)
    after = cutting.clips_by_video(digests, [2] * 40, cut, shares)
    moved = {v for s in SPLITS for v, _ in before[s]} - {v for s in SPLITS for v, _ in before[s] if (v, 0) in after[s]}
    assert len(moved) <= 2


def test_training_without_labels_says_what_needs_them(tmp_path: Path, videos: Path, command: Callable[..., Ended]):
    words = ("--config-dir", str(Path(__file__).parents[1] / "conf"), "model=tiny", "scale=smoke", "data=video")
    path = f'data.path="{videos}"'
    ended = command("train", *words, path, "trainer.max_steps=2", "evaluation.pictures=0")
    assert ended.code == 0, ended.err
    assert "unlabelled, so there are no scores" in ended.out
    assert "best.ckpt has the lowest val/loss, since val/ari_fg needs labels" in ended.out
    (run,) = (path.parent for path in tmp_path.glob("outputs/*/*/metrics.json"))
    scores = json.loads((run / "metrics.json").read_text())["splits"]["test"]
    assert scores["labelled"] is False
    assert "ari_fg" not in scores["total"]
    header = (run / "curves.csv").read_text().splitlines()[0].split(",")
    assert "val/loss" in header
    assert "val/objects_present" in header
    assert not any("ari" in name or "msc" in name for name in header)
    assert (run / "checkpoints" / "best.ckpt").exists()
    refused = command("train", "model=oracle", "scale=smoke", "data=video", path)
    assert refused.code != 0
    assert "needs labels" in refused.err
    stop = "{_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/ari_fg, mode: max}"
    refused = command("train", *words, path, f"+callbacks.stop={stop}")
    assert refused.code != 0
    assert "callbacks.stop.monitor = val/ari_fg needs labels" in refused.err


def test_the_experiment_is_apex_at_cpu_scale_on_own_videos(command: Callable[..., Ended]):
    shown = yaml.safe_load(command("train", "+experiment=own_video", "data.path=x", "--cfg", "job", "--resolve").out)
    assert shown["data"]["_target_"] == "apex_lab.data.OwnVideosSource"
    assert (shown["data"]["frames"], shown["data"]["image_size"], shown["data"]["stride"]) == (8, 64, 3)
    recipe = yaml.safe_load((REPOSITORY / "conf" / "recipe" / "apex" / "cpu.yaml").read_text())
    assert shown["trainer"]["max_steps"] == recipe["trainer"]["max_steps"]
    assert (shown["trainer"]["monitor"], shown["trainer"]["monitor_mode"]) == ("val/loss", "min")

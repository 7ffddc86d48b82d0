"""`python -m sims.p2d`: settings from arguments, exit codes, messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from sims.p2d import __main__ as command
from sims.p2d.settings import Settings
from sims.p2d.settings_text import SettingsError, command_words, settings_from
from sims.p2d.store import read_manifest
from tests.fakes.p2d_tools import FAKE, content, make, small, start, words


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    make, repair = command.generate, command.repair
    monkeypatch.setattr(command, "generate", lambda *a, **k: make(*a, simulator=FAKE, shown=False, **k))
    monkeypatch.setattr(command, "repair", lambda *a, **k: repair(*a, simulator=FAKE, shown=False, **k))


def test_settings_from_words():
    settings = settings_from(["frames=8", "aim=1", 'objects=["mug","pear","apple"]', "camera.fov_deg=50"])
    assert settings == Settings(
        frames=8,
        aim=1.0,
        objects=("mug", "pear", "apple"),
        camera=Settings().camera.model_copy(update={"fov_deg": 50.0}),
    )


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("frame=8", "unknown setting 'frame': did you mean frames?"),
        ("zzz=8", "unknown setting 'zzz': known are aim, "),
        ("frames=many", "setting frames='many' is not possible: input should be a valid integer"),
        ("frames=0", "setting frames=0 is not possible: input should be greater than or equal to 1"),
        ("frames=2.5", "setting frames=2.5 is not possible: input should be a valid integer"),
        ("frames=true", "setting frames=True is not possible: input should be a valid integer"),
        ("aim=NaN", "setting aim='NaN' is not possible: input should be a valid number"),
        ("renderer=blender", "setting renderer='blender' is not possible: input should be 'tiny' or 'egl'"),
        ("min_objects=4", "settings do not fit together: min_objects 4 must not exceed max_objects 3"),
        ("camera.fog=1", "unknown setting 'camera.fog': did you mean camera."),
        ("camera.fov=1", "unknown setting 'camera.fov': did you mean camera.fov_deg?"),
        ("frames.x=1", "--set frames.x=1: frames has no nested settings"),
        ("frames", "--set frames: expected key=value"),
    ],
)
def test_wrong_settings_are_refused_in_one_sentence(word: str, sentence: str):
    with pytest.raises(SettingsError) as caught:
        settings_from([word], Settings())
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)


def test_words_of_a_command_give_the_settings_back():
    settings = small(aim=0.25, camera={"fov_deg": 50.0})
    import shlex

    assert settings_from(shlex.split(command_words(settings))[1:]) == settings
    assert command_words(Settings()) == ""


def test_make_verify_repair(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    root = tmp_path / "p2d"
    assert command.main(["--out", str(root), *words(small()), "--workers", "1", "--no-card"]) == 0
    assert "8 train, 2 val, 2 test trajectories" in capsys.readouterr().out
    assert command.main(["verify", str(root)]) == 0
    assert "all checksums match" in capsys.readouterr().out
    (root / "val" / "poses.npy").unlink()
    assert command.main(["verify", str(root)]) == 1
    out = capsys.readouterr().out
    assert "val/poses.npy is missing" in out
    assert "trajectory val/0-1: bytes do not match the checksum" in out
    assert command.main(["verify", str(root), "--repair"]) == 0
    assert capsys.readouterr().out.endswith(f"{root}: repaired\n")
    assert command.main(["verify", str(root), "--repair"]) == 0
    assert capsys.readouterr().out == f"{root}: no damage found\n"


def test_settings_need_not_be_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make(tmp_path)
    assert command.main(["--out", str(tmp_path), "--no-card"]) == 0
    assert command.main(["--out", str(tmp_path), "--no-card", "--set", "frames=4"]) == 1
    assert "frames is 3 there and 4 here" in capsys.readouterr().err


def test_exit_codes_and_no_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert command.main(["--out", str(tmp_path / "a"), "--set", "frame=1"]) == 2
    assert capsys.readouterr().err == "unknown setting 'frame': did you mean frames?\n"
    assert not (tmp_path / "a").exists()
    assert command.main(["verify", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err.startswith("no P2D data at ")
    with pytest.raises(SystemExit) as caught:
        command.main(["--out", str(tmp_path / "a"), "--workers", "0"])
    assert caught.value.code == 2


def test_progress_without_a_terminal_is_plain_lines(tmp_path: Path):
    process = start("--out", tmp_path, *words(small()), "--workers", 1, "--no-card")
    _, text = process.communicate(timeout=120)
    assert process.returncode == 0
    lines = text.splitlines()
    assert lines[0] == f"P2D {tmp_path.name}: 12 trajectories"
    assert lines[-1].startswith(f"P2D {tmp_path.name}: 12 trajectories in ")
    assert "\x1b" not in text


@pytest.mark.parametrize(
    ("settings", "workers"),
    [
        (Settings(train=2, val=1, test=0, frames=2, image_size=32), 2),
        pytest.param(Settings(train=20, val=3, test=3, frames=6, image_size=64, seed=5), 5, marks=pytest.mark.slow),
    ],
)
def test_the_real_simulator_gives_the_same_bytes_with_any_number_of_workers(
    tmp_path: Path, settings: Settings, workers: int
):
    pytest.importorskip("pybullet")
    from sims.p2d.generate import generate

    one = generate(tmp_path / "one", settings, workers=1, shown=False)
    generate(tmp_path / "two", settings, workers=workers, shown=False, recycle=4)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert read_manifest(tmp_path / "one") == one
    assert "pybullet" in one.facts["versions"]
    assert len(one.facts["camera"]["intrinsics"]) == 3

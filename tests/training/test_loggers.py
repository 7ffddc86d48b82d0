from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from apex_lab.base.wandb_account import credentials
from apex_lab.training.loggers import Curves
from tests.conftest import TINY, Ended
from tests.test_train import start, wait_for_step, weights, without_speed
from tests.training import wandb_file


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_curves_have_a_row_per_step_and_grow_columns(tmp_path: Path) -> None:
    path = tmp_path / "curves.csv"
    curves = Curves(path)
    curves.log_metrics({"train/loss": 1.5}, 10)
    assert lines(path) == ["step,train/loss", "10,1.5"]
    curves.log_metrics({"train/loss": 1.25}, 20)
    curves.log_metrics({"val/ari": 0.5}, 20)
    curves.log_metrics({"train/loss": 1.0}, 30)
    assert lines(path) == ["step,train/loss,val/ari", "10,1.5,", "20,1.25,0.5", "30,1.0,"]


def test_curves_of_a_resumed_run_lose_what_will_be_done_again(tmp_path: Path) -> None:
    path = tmp_path / "curves.csv"
    first = Curves(path)
    for step in (10, 20, 30):
        first.log_metrics({"train/loss": float(step)}, step)
    with open(path, "a") as file:
        file.write("40")  # a row that a kill cut off
    second = Curves(path, step=20)
    second.log_metrics({"train/loss": 31.0}, 30)
    assert lines(path) == ["step,train/loss", "10,10.0", "20,20.0", "30,31.0"]


DAMAGED = {
    "empty": ("", 0),
    "binary": (bytes(range(256)).decode("latin-1"), 0),
    "without steps": ("train/loss,val/loss\n1,2\n", 0),
    "two columns of one name": ("step,a,a\n10,1,2\n", 0),
    "a row of words in the middle": ("step,a\n10,1.0\nso,what\n20,2.0\n", 2),
    "a row with too many values": ("step,a\n10,1.0\n15,1,2\n20,2.0\n", 2),
    "bytes that are no text": ("step,a\n10,1.0\n15,\udcff\n20,2.0\n", 2),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_curves_are_set_aside_and_whole_rows_kept(
    damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text, kept = DAMAGED[damage]
    content = text.encode("latin-1" if damage == "binary" else "utf-8", "surrogateescape")
    path = tmp_path / "curves.csv"
    path.write_bytes(content)
    curves = Curves(path, step=20)
    assert [row["step"] for row in curves.rows] == ["10", "20"][:kept]
    curves.log_metrics({"a": 3.0}, 30)
    assert lines(path)[-1].startswith("30,")
    aside = tmp_path / "curves.damaged.csv"
    assert aside.exists() == bool(content)
    if content:
        assert aside.read_bytes() == content


def test_a_value_may_be_logged_late(tmp_path: Path) -> None:
    curves = Curves(tmp_path / "curves.csv")
    curves.log_metrics({"a": 1.0}, 10)
    curves.log_metrics({"a": 3.0}, 30)
    curves.log_metrics({"a": 2.0}, 20)
    curves.log_metrics({"b": 1.5}, 10)
    curves.log_metrics({"a": 0.0}, 5)
    assert lines(tmp_path / "curves.csv") == ["step,a,b", "5,0.0,", "10,1.0,1.5", "20,2.0,", "30,3.0,"]


def test_curves_need_a_step(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="needs a step"):
        Curves(tmp_path / "curves.csv").log_metrics({"a": 1.0})


def test_credentials_are_looked_for_without_asking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    assert not credentials()
    (tmp_path / "netrc").write_text("machine example.org login user password secret\n")
    assert not credentials()
    (tmp_path / "netrc").write_text("machine api.wandb.ai login user password secret\n")
    assert credentials()
    monkeypatch.delenv("NETRC")
    assert not credentials()
    monkeypatch.setenv("WANDB_API_KEY", "x" * 40)
    assert credentials()


def offline_folders(run: Path) -> list[Path]:
    return sorted((run / "wandb").glob("offline-run-*"))


def as_killed_after_step_6(run: Path) -> None:
    """Takes from the curves what a run that broke at step 7 logged there."""
    kept = [line for line in lines(run / "curves.csv") if not line.startswith("7,")]
    (run / "curves.csv").write_text("\n".join(kept) + "\n")


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_wandb_offline_is_complete_also_after_a_kill_and_resumption(
    killed: bool,
    train: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    words = ("logger=wandb", "trainer.max_steps=12", "trainer.checkpoint_interval=3", "evaluation.pictures=1")
    if killed:
        process = start(tmp_path, *words)
        run = wait_for_step(tmp_path, 6)
        process.kill()
        process.communicate()
    else:
        monkeypatch.setenv("TINY_BROKEN_AT", "7")
        assert train(*words).code == 1
        monkeypatch.delenv("TINY_BROKEN_AT")
        run = the_run()
        as_killed_after_step_6(run)
    name = json.loads((run / "run.json").read_text())["wandb_id"]
    (run / "run.json").unlink()  # the checkpoint knows the id too
    ended = train(*words)
    assert ended.code == 0, ended.err
    assert "wandb: no credentials, logging offline" in ended.out
    assert json.loads((run / "run.json").read_text())["wandb_id"] == name
    folders = offline_folders(run)
    assert len(folders) == 2
    first, second = (wandb_file.records(folder / f"run-{name}.wandb") for folder in folders)
    resumed = int(ended.out.split("resuming from step ")[1].split()[0])
    for part in (first, second):
        about = wandb_file.run(part)
        assert (about.run_id, about.project, about.job_type) == (name, "apex_lab", "train")
        assert about.run_group == run.parent.name
        assert about.display_name == f"{run.parent.name}_seed_0"
        assert set(about.tags) == {"tiny", "squares", "smoke"}
        assert wandb_file.config(part)["trainer"]["max_steps"] == 12
        steps = [row["_step"] for row in wandb_file.history(part)]
        assert steps == sorted(steps)
        assert steps == [row["step"] for row in wandb_file.history(part)]
    assert wandb_file.history(first)[0]["_step"] == 1
    # wandb keeps values and pictures of a step until the next one, so the last row may come again
    again = wandb_file.history(second)[0]
    assert again["_step"] in (resumed, resumed + 1)
    if not killed:
        assert (again["_step"], again["val/pictures"]["_type"]) == (6, "image-file")
    with open(run / "curves.csv", newline="") as file:
        rows = {int(row["step"]): row for row in csv.DictReader(file)}
    assert [path.name for path in (run / "wandb").glob("last_picture*")] == ["last_picture.val%2Fpictures.12.png"]
    sent: dict[int, dict[str, Any]] = {}
    for row in (*wandb_file.history(first), *wandb_file.history(second)):
        sent.setdefault(row["_step"], {}).update(row)
    assert sorted(sent) == sorted(rows) == list(range(1, 13))
    for step, row in rows.items():
        for key, value in row.items():
            if value and key != "train/frames_per_second":
                assert sent[step][key] == float(value), (step, key)
    scored = json.loads((run / "metrics.json").read_text())["splits"]["test"]
    final = wandb_file.summary(second)
    for key, value in scored["total"].items():
        if isinstance(value, int | float):
            assert final[f"test/{key}"] == value, key
    shown = wandb_file.history(second)[-1]
    files = folders[1] / "files"
    assert (shown["test/film_strip"]["_type"], shown["test/movie"]["_type"]) == ("image-file", "video-file")
    assert (files / shown["test/film_strip"]["path"]).read_bytes() == (run / "view" / "film_strip.png").read_bytes()
    drawn = {
        row["_step"]: folder
        for folder, part in ((folders[0], first), (folders[1], second))
        for row in wandb_file.history(part)
        if "val/pictures" in row
    }
    assert sorted(drawn) == [3, 6, 9, 12]
    table = json.loads((files / shown["test/per_video"]["path"]).read_text())
    place = table["columns"].index("ari_fg")
    assert [row[place] for row in table["data"]] == [row["ari_fg"] for row in scored["per_video"]]


def test_wandb_goes_on_without_a_kept_picture_that_is_damaged(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("TINY_BROKEN_AT", "7")
    words = ("logger=wandb", "trainer.max_steps=9", "trainer.checkpoint_interval=3")
    assert train(*words).code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")
    run = the_run()
    as_killed_after_step_6(run)
    [picture] = (run / "wandb").glob("last_picture.*.6.png")
    picture.write_bytes(picture.read_bytes()[:-100])
    (run / "wandb" / "notes.6.png").write_bytes(b"the user's own")
    ended = train(*words)
    assert ended.code == 0, ended.err
    assert f"{picture.name} cannot be read" in ended.err
    assert "notes.6.png" not in ended.err
    again = wandb_file.history(wandb_file.records(next(offline_folders(run)[1].glob("*.wandb"))))[0]
    assert again["_step"] == 6
    assert "val/pictures" not in again
    assert "val/loss" in again


def test_wandb_shows_pictures_and_changes_no_number(
    train: Callable[..., Ended], trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    plain = trained.rename(trained.with_name("plain"))
    assert train("logger=wandb", "logger.wandb.pictures_every=2").code == 0
    assert without_speed(trained) == without_speed(plain)
    ours, theirs = weights(trained), weights(plain)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    [folder] = offline_folders(trained)
    rows = wandb_file.history(wandb_file.records(next(folder.glob("*.wandb"))))
    [(step, shown)] = [(row["_step"], row["val/pictures"]) for row in rows if "val/pictures" in row]
    assert (step, shown["_type"]) == (6, "image-file")
    with Image.open(folder / "files" / shown["path"]) as picture:
        assert picture.height > 2 * 5 * 128  # two videos of five rows


def test_wandb_takes_the_scores_of_a_model_that_does_not_train(
    command: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    assert command("train", *TINY, "model=one_segment", "logger=wandb").code == 0
    [folder] = offline_folders(the_run())
    [file] = folder.glob("*.wandb")
    assert "test/ari" in wandb_file.summary(wandb_file.records(file))


def test_wandb_with_a_network_that_is_away_falls_back_to_offline(
    train: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # the discard port: nobody answers
    monkeypatch.setattr("apex_lab.training.loggers.TIMEOUT", 3.0)
    ended = train("logger=wandb")
    assert ended.code == 0, ended.err
    assert "wandb: cannot be reached" in ended.err
    assert len(offline_folders(the_run())) == 1

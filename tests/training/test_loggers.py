from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from apex_lab.training.loggers import Curves, credentials
from tests.conftest import Ended


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


def test_wandb_without_credentials_is_offline_and_keeps_its_id(
    train: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train("logger=wandb").code == 1
    run = the_run()
    name = json.loads((run / "run.json").read_text())["wandb_id"]
    monkeypatch.delenv("TINY_BROKEN_AT")
    ended = train("logger=wandb")
    assert ended.code == 0
    assert "wandb: no credentials, logging offline" in ended.out
    assert json.loads((run / "run.json").read_text())["wandb_id"] == name
    folders = offline_folders(run)
    assert len(folders) == 2
    assert all(folder.name.endswith(name) for folder in folders)
    stored = (folders[1] / f"run-{name}.wandb").read_bytes()
    for word in (run.parent.name, "train/loss", "val/ari_fg", "smoke"):
        assert word.encode() in stored, word


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

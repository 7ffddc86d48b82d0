from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.config.upgrades import FORMAT
from apex_lab.runs import checkpoints


def content(step: int = 3) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(step)
    return {
        "step": step,
        "inference": {
            "model": {"size": 3},
            "weights": {"layer.weight": torch.randn(40, 50, generator=generator)},
            "schedule": {"noise": 0.5},
            "attributes": {"tracks": True},
            "precision": 32,
            "seed": 0,
        },
        "config": {"seed": 0, "model": {"size": 3}},
        "choices": {"model": "tiny"},
        "training": {
            "optimizer": {"state": {0: {"step": torch.tensor(3.0)}}},
            "callbacks": {},
            "best": None,
            "seconds": 1.5,
        },
    }


def test_what_is_saved_is_read_back_and_readable_by_weights_only(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content())
    loaded = checkpoints.load(path)
    assert torch.equal(
        loaded["inference"]["weights"]["layer.weight"], content()["inference"]["weights"]["layer.weight"]
    )
    assert loaded["config"] == {"seed": 0, "model": {"size": 3}}
    assert torch.load(path, weights_only=True)["format"] == FORMAT


def test_the_one_before_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    for step in (1, 2, 3):
        checkpoints.save(path, content(step), keep_previous=True)
    assert checkpoints.load(path)["step"] == 3
    assert checkpoints.load(checkpoints.previous(path))["step"] == 2
    assert {file.name for file in tmp_path.iterdir()} == {"last.ckpt", "previous.ckpt"}


def test_every_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content())
    whole = path.read_bytes()
    for length in range(0, len(whole), max(1, len(whole) // 23)):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError, match=str(path)):
            checkpoints.load(path)


def test_a_flipped_bit_in_the_weights_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content())
    whole = bytearray(path.read_bytes())
    numbers = content()["inference"]["weights"]["layer.weight"].numpy().tobytes()
    whole[whole.index(numbers[:64]) + 1000] ^= 1
    path.write_bytes(whole)
    with pytest.raises(UserError, match="is damaged"):
        checkpoints.load(path)


@pytest.mark.parametrize("other", [b"", b"not a checkpoint", b"PK\x05\x06" + b"\0" * 18])
def test_other_files_are_refused(other: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.ckpt"
    path.write_bytes(other)
    with pytest.raises(UserError, match="checkpoint"):
        checkpoints.load(path)
    with pytest.raises(UserError, match="There is no checkpoint at"):
        checkpoints.load(tmp_path / "missing.ckpt")


def test_other_people_s_checkpoints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.ckpt"
    torch.save({"state_dict": {"a": torch.zeros(3)}}, path)
    with pytest.raises(UserError, match="is no apex_lab checkpoint"):
        checkpoints.load(path)
    torch.save({**content(), "format": 99}, path)
    with pytest.raises(UserError, match="has format 99, this version of apex_lab reads 1, 2: use the"):
        checkpoints.load(path)


def test_weights_of_a_diverged_run_are_refused(tmp_path: Path) -> None:
    sick = content()
    sick["inference"]["weights"]["layer.weight"][3, 4] = float("nan")
    checkpoints.save(tmp_path / "last.ckpt", sick)
    with pytest.raises(UserError, match="weights that are not finite"):
        checkpoints.load(tmp_path / "last.ckpt")


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "touched",))

    path = tmp_path / "evil.ckpt"
    inference = {**content()["inference"], "weights": Evil()}
    torch.save({**content(), "format": FORMAT, "inference": inference}, path)
    with pytest.raises(UserError, match="is damaged or no checkpoint"):
        checkpoints.load(path)
    assert not (tmp_path / "touched").exists()


def test_a_failed_write_leaves_the_file_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content(1))

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(UserError, match=rf"No space left for {path} .*free there.: free some"):
        checkpoints.save(path, content(2), keep_previous=True)
    assert checkpoints.load(path)["step"] == 1
    assert {file.name for file in tmp_path.iterdir()} == {"last.ckpt"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_torch_s_own_error_on_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import builtins

    real = builtins.open

    def onto_full(path: Any, *arguments: Any, **options: Any) -> Any:
        return real("/dev/full" if str(path).endswith(".part") else path, *arguments, **options)

    monkeypatch.setattr(builtins, "open", onto_full)
    with pytest.raises(UserError, match="No space left for"):
        checkpoints.save(tmp_path / "last.ckpt", content())


def test_a_glance_reads_the_plain_values_alone_and_calls_nothing(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content())
    assert checkpoints.glance(path) == {key: content()[key] for key in ("step", "config", "choices")}

    proof = tmp_path / "proof"

    class Hostile:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, (f"touch {proof}",)

    torch.save({"format": FORMAT, **content(), "config": {"seed": 0, "x": Hostile()}}, path)
    checkpoints.glance(path)
    assert not proof.exists()
    with pytest.raises(UserError, match=r"is damaged or no checkpoint \(UnpicklingError\)"):
        checkpoints.load(path)
    assert not proof.exists()


def test_a_glance_of_a_damaged_file_is_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    checkpoints.save(path, content())
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("data.pkl")]
        inside = archive.read(name)
    start = whole.index(inside)
    for place in range(0, len(inside), 7):
        damaged = bytearray(whole)
        damaged[start + place] ^= 255
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="is damaged or no checkpoint"):
            checkpoints.glance(path)

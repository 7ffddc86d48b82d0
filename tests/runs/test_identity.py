"""Runs are found by what was run, under names of older versions too, and nothing is read twice."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from apex_lab.base.errors import UserError
from apex_lab.config.upgrades import fingerprint
from apex_lab.runs import identity
from apex_lab.runs.identity import Outputs, group_name, seed_folders

CHOICES = {"model": "m", "data": "d", "scale": "s"}
PINNED = Path(__file__).parent.parent / "pinned" / "format_1"


def run_folder(raw: dict[str, Any], choices: dict[str, str], outputs: Outputs | None = None) -> Path:
    outputs = outputs or Outputs(Path(raw["paths"]["outputs"]))
    return identity.run_folder(outputs, fingerprint(raw), choices, raw["seed"])


def raw(outputs: Path, seed: int = 0, **values: Any) -> dict[str, Any]:
    return {"seed": seed, "paths": {"outputs": str(outputs)}, "model": values}


def record(folder: Path, **content: Any) -> Path:
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(content))
    return folder


def test_names(tmp_path: Path) -> None:
    configuration = raw(tmp_path, seed=3)
    digest = fingerprint(configuration)
    digest, whole = digest[:8], digest
    assert group_name(whole, CHOICES) == f"m_d_s_{digest}"
    assert group_name(whole, {**CHOICES, "ablation": "a", "tuned": "t"}) == f"m_a_tuned_t_d_s_{digest}"
    assert run_folder(configuration, CHOICES) == tmp_path / f"m_d_s_{digest}" / "seed_3"


def test_a_run_under_an_older_name_is_found_by_its_record(tmp_path: Path) -> None:
    configuration = raw(tmp_path)
    record(tmp_path / "m_d_s_00000000" / "seed_0", format=2, fingerprint="0" * 64)
    older = record(tmp_path / "m_d_s_11111111" / "seed_0", format=2, fingerprint=fingerprint(configuration))
    record(tmp_path / "m_a_d_s_11111111" / "seed_0", format=2, fingerprint=fingerprint(configuration))
    assert run_folder(configuration, CHOICES) == older
    named = tmp_path / group_name(fingerprint(configuration), CHOICES) / "seed_0"
    named.mkdir(parents=True)
    assert run_folder(configuration, CHOICES) == named


def test_a_run_whose_record_is_lost_is_found_by_its_configuration(tmp_path: Path) -> None:
    configuration = raw(tmp_path)
    folder = tmp_path / "m_d_s_11111111" / "seed_0"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(configuration))
    assert run_folder(configuration, CHOICES) == folder
    (folder / "config.yaml").write_text("[")
    assert run_folder(configuration, CHOICES) != folder


def test_seeds_of_format_1_are_found_and_each_configuration_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(PINNED, tmp_path / "outputs")
    (group,) = (tmp_path / "outputs").iterdir()
    stored = yaml.safe_load((group / "seed_0" / "config.yaml").read_text())
    for seed in range(1, 5):
        shutil.copytree(group / "seed_0", group / f"seed_{seed}")
    today = identity.upgraded(stored, 1)
    read: list[str] = []
    load = identity._upgraded_fingerprint
    monkeypatch.setattr(
        identity, "_upgraded_fingerprint", lambda folder, f: (read.append(folder.name), load(folder, f))[1]
    )
    outputs, choices = Outputs(tmp_path / "outputs"), {"model": "apex", "data": "p2d", "scale": "smoke"}
    for seed in range(5):
        assert run_folder({**today, "seed": seed}, choices, outputs) == group / f"seed_{seed}"
    assert len(read) == 1
    missing = run_folder({**today, "seed": 9}, choices, outputs)
    assert missing.name == "seed_9"
    assert missing.parent != group


def test_folders_are_listed_once_however_many_runs_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(20):
        record(tmp_path / f"m_d_s_{number:08x}" / "seed_0", format=2, fingerprint=f"{number:064x}")
    reads: list[Path] = []
    read_record = identity.read_record
    monkeypatch.setattr(identity, "read_record", lambda path: (reads.append(path), read_record(path))[1])
    outputs = Outputs(tmp_path)
    for value in range(50):
        run_folder(raw(tmp_path, value=value), CHOICES, outputs)
    assert len(reads) == 20


def test_folders_of_seeds(tmp_path: Path) -> None:
    for name in ("b_0/seed_10", "b_0/seed_9", "a_0/seed_0", "a_0/seed_01", "a_0/seed_1_old", "tables/x"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "notes.txt").write_text("")
    assert [str(path.relative_to(tmp_path)) for path in seed_folders(tmp_path)] == [
        "a_0/seed_0",
        "b_0/seed_9",
        "b_0/seed_10",
    ]
    assert seed_folders(tmp_path / "nowhere") == []
    with pytest.raises(UserError, match=r"paths\.outputs = .*notes\.txt cannot be read"):
        seed_folders(tmp_path / "notes.txt")

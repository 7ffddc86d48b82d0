"""A run keeps its identity when keys are added, and what older versions left behind is found and read."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from apex_lab.config import job as jobs
from apex_lab.config import schema, upgrades
from apex_lab.config.building import build_model
from apex_lab.config.upgrades import ADDED, FORMAT, fingerprint, upgraded
from apex_lab.runs import checkpoints
from tests.conftest import REPOSITORY, Ended, compose_job

OLD = REPOSITORY / "tests" / "pinned" / "format_1" / "apex_p2d_smoke_c2ea6a76"
SHIPPED = REPOSITORY / "sweeps" / "results" / "apex_p2d_cpu.ckpt"
WORDS = (
    *("scale=smoke", "trainer.max_steps=50", "trainer.log_interval=1"),
    *("trainer.validation_interval=25", "evaluation.pictures=0"),
)
"""The command that made the run of format 1."""


@pytest.fixture
def with_dummy_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """The schema with one more key, as the next version might have it: with a default, and its entry among `ADDED`."""

    class Trainer(schema.TrainerPart):
        dummy: int = 7

    class Config(schema.Config):
        trainer: Trainer

    monkeypatch.setattr(jobs, "Config", Config)
    monkeypatch.setitem(ADDED, "trainer.dummy", 7)


def test_a_new_key_at_its_old_value_changes_no_fingerprint(with_dummy_key: None) -> None:
    raw = compose_job().raw
    with_key = {**raw, "trainer": {**raw["trainer"], "dummy": 7}}
    other = {**raw, "trainer": {**raw["trainer"], "dummy": 8}}
    assert fingerprint(with_key) == fingerprint(raw)
    assert fingerprint(other) != fingerprint(raw)


def test_a_key_in_a_new_section_changes_no_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = compose_job().raw
    monkeypatch.setitem(ADDED, "augment.flip", False)
    assert fingerprint({**raw, "augment": {"flip": False}}) == fingerprint(raw)
    assert fingerprint({**raw, "augment": {"flip": 0}}) != fingerprint(raw)  # 0 is not False
    assert fingerprint({**raw, "augment": {"flip": True}}) != fingerprint(raw)


@pytest.mark.usefixtures("with_dummy_key")
def test_with_a_new_key_a_finished_run_is_found(command: Callable[..., Ended], tmp_path: Path) -> None:
    shutil.copytree(OLD, tmp_path / "outputs" / OLD.name)
    ended = command("train", *WORDS, "+trainer.dummy=7")
    assert ended.code == 0, ended.err
    assert ended.out.startswith("finished already: outputs/apex_p2d_smoke_c2ea6a76/seed_0")


@pytest.mark.usefixtures("with_dummy_key")
def test_with_a_new_key_the_shipped_checkpoint_loads(command: Callable[..., Ended], tmp_path: Path) -> None:
    content = checkpoints.load(SHIPPED)
    job = jobs.check_job(content["config"], content["choices"], needs_recipe=False)
    build_model(job.config).load_state_dict(content["inference"]["weights"])
    assert job.config.trainer.dummy == 7  # type: ignore[attr-defined]


def test_a_finished_run_of_format_1_is_found_and_other_settings_are_not(
    command: Callable[..., Ended], tmp_path: Path, p2d_smoke: str
) -> None:
    shutil.copytree(OLD, tmp_path / "outputs" / OLD.name)
    ended = command("train", *WORDS)
    assert ended.code == 0, ended.err
    assert "finished already: outputs/apex_p2d_smoke_c2ea6a76/seed_0" in ended.out
    other = ("optimizer.lr=1e-3", "trainer.max_steps=1", "trainer.validation_interval=null")
    ended = command("train", *WORDS, *other, p2d_smoke)
    assert ended.code == 0, ended.err
    assert "finished already" not in ended.out


def test_a_checkpoint_of_format_1_gives_the_scores_that_it_gave(
    command: Callable[..., Ended], tmp_path: Path, p2d_smoke: str
) -> None:
    before = json.loads((OLD / "seed_0" / "metrics.json").read_text())["splits"]["test"]
    shutil.copy(OLD / "seed_0" / "checkpoints" / "last.ckpt", tmp_path / "old.ckpt")
    ended = command("evaluate", "checkpoint=old.ckpt", "folder=scores", "pictures=0", p2d_smoke)
    assert ended.code == 0, ended.err
    after = json.loads((tmp_path / "scores" / "metrics.json").read_text())["splits"]["test"]
    for key in ("ari_fg", "msc_fg", "ari", "msc", "mota", "misses"):
        assert after["total"][key] == pytest.approx(before["total"][key], abs=1e-6), key


def test_an_unfinished_run_of_format_1_resumes(command: Callable[..., Ended], tmp_path: Path, p2d_smoke: str) -> None:
    run = tmp_path / "outputs" / OLD.name / "seed_0"
    shutil.copytree(OLD, run.parent)
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, "status": "failed", "steps": 48}))
    (run / "metrics.json").unlink()
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    torch.save({**content, "step": 48}, run / "checkpoints" / "last.ckpt")
    ended = command("train", *WORDS, p2d_smoke)
    assert ended.code == 0, ended.err
    assert "resuming from step 48" in ended.out
    assert json.loads((run / "run.json").read_text())["format"] == FORMAT
    assert checkpoints.load(run / "checkpoints" / "last.ckpt")["step"] == 50
    # it keeps its folder for good
    ended = command("train", *WORDS)
    assert ended.out.startswith("finished already: outputs/apex_p2d_smoke_c2ea6a76/seed_0")
    assert len(list((tmp_path / "outputs").iterdir())) == 1


def test_a_configuration_of_format_1_has_todays_keys() -> None:
    old: dict[str, Any] = yaml.safe_load((OLD / "seed_0" / "config.yaml").read_text())
    new = upgraded(old, 1)
    assert new["clips"] == {"batch_size": old["data"]["batch_size"], "frames": None}
    assert not {"batch_size", "eval_batch_size", "seed"} & new["data"].keys()
    assert new["data"]["_target_"] == "apex_lab.data.P2DSource"
    assert new["schedule"]["carry"]["_target_"] == "apex_lab.training.schedules.Linear"
    assert old["data"]["_target_"] == "apex_lab.data.P2DModule"  # the old one is left as it was
    assert upgraded(new, FORMAT) == new


@pytest.mark.parametrize("key", upgrades.EXCLUDED)
def test_excluded_keys_change_no_fingerprint(key: str) -> None:
    raw = compose_job().raw
    changed = {**raw}
    group, _, name = key.partition(".")
    changed[group] = {**(raw[group] or {}), name: "other"} if name else "other"
    assert fingerprint(changed) == fingerprint(raw)


def test_every_added_key_has_its_default() -> None:
    """In the schema, or in the files of the models that have it."""
    configs = [compose_job(f"model={model}").config.model_dump() for model in ("apex", "gswm", "op3", "scalor")]
    for key, before in ADDED.items():
        found: list[Any] = []
        for value in configs:
            for word in key.split("."):
                value = value.get(word, {}) if isinstance(value, dict) else {}
            found += [] if value == {} else [value]
        assert found, key
        # the recipe of OP3 cuts disjoint clips
        assert before in found if key == "clips.starts" else all(value == before for value in found), key

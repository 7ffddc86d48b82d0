"""What an ablation sets is in force in the run that bears its name, or the run is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from apex_lab.base.errors import UserError
from apex_lab.config import ablations
from tests.conftest import REPOSITORY, Ended, compose_job

SMOKE = ("model=apex", "data=p2d", "scale=smoke")
APEX = "apex_lab.models.apex"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("words", "sets", "found"),
    [
        (("+ablation=gaussian", "model/apex/likelihood=mixture"), "likelihood=gaussian", "likelihood=mixture"),
        (("+ablation=scalor_norm", "model/apex/masks=apex"), "masks=scalor", "masks=apex"),
        (("+ablation=gaussian_scalor_norm", "model/apex/masks=apex"), "masks=scalor", "masks=apex"),
        (("+ablation=image_stn", "model/apex/glimpses=features"), "glimpses=image", "glimpses=features"),
        (
            ("+ablation=gaussian", f"model.likelihood._target_={APEX}.MixtureLikelihood", "~model.likelihood.sigma"),
            f"model.likelihood._target_='{APEX}.GaussianLikelihood'",
            f"model.likelihood._target_='{APEX}.MixtureLikelihood'",
        ),
        (
            ("+ablation=image_stn", f"model.glimpses._target_={APEX}.FeatureGlimpses"),
            f"model.glimpses._target_='{APEX}.ImageGlimpses'",
            f"model.glimpses._target_='{APEX}.FeatureGlimpses'",
        ),
        (("+ablation=no_entropy", "loss.mask_entropy=1.0"), "loss.mask_entropy=0.0", "loss.mask_entropy=1.0"),
        (("+ablation=no_entropy", "~loss.mask_entropy"), "loss.mask_entropy=0.0", "no loss.mask_entropy"),
        (
            ("+ablation=no_entropy", "loss.mask_entropy={_target_:apex_lab.training.schedules.Constant,value:2.0}"),
            "loss.mask_entropy=0.0",
            "loss.mask_entropy={'_target_': 'apex_lab.training.schedules.Constant', 'value': 2.0}",
        ),
    ],
)
def test_what_undoes_an_ablation_is_refused(words: tuple[str, ...], sets: str, found: str) -> None:
    name = words[0].partition("=")[2]
    with pytest.raises(UserError) as refused:
        compose_job(*SMOKE, *words)
    assert str(refused.value) == (
        f"+ablation={name} sets {sets}, and this run has {found}, so it is not that ablation: "
        "leave out one of them, or describe the run by its values alone."
    )


@pytest.mark.parametrize(
    "words",
    [
        ("+ablation=gaussian", "model/apex/likelihood=gaussian"),
        ("+ablation=gaussian", "model.likelihood.sigma=0.2"),  # of the swapped part: tuned, not undone
        ("+ablation=gaussian", "model/apex/masks=scalor"),
        ("+ablation=no_entropy", "loss.mask_entropy=0"),
        ("+ablation=image_stn", "model.grid=2", "seed=3"),
        ("model/apex/likelihood=gaussian",),
        ("+experiment=overfit", "data.train=5"),  # a starting point
    ],
)
def test_what_leaves_an_ablation_in_force_is_taken(words: tuple[str, ...]) -> None:
    assert compose_job(*SMOKE, *words).choices["model"] == "apex"


def test_an_experiment_that_undoes_an_ablation_is_refused(command: Callable[..., Ended], tmp_path: Path) -> None:
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    text = "# @package _global_\ndefaults:\n  - override /model/apex/likelihood: mixture\n"
    (tmp_path / "conf" / "experiment" / "mine.yaml").write_text(text)
    words = ("--config-dir", str(tmp_path / "conf"), "scale=smoke", "+ablation=gaussian", "+experiment=mine")
    ended = command("train", *words)
    assert ended.code == 2
    assert "+ablation=gaussian sets likelihood=gaussian, and this run has likelihood=mixture" in ended.err
    assert len(ended.err.splitlines()) == 1
    ended = command("train", "scale=smoke", "+ablation=gaussian", "likelihood=mixture")
    assert (ended.code, len(ended.err.splitlines())) == (2, 1)
    assert not (tmp_path / "outputs").exists()


def test_every_shipped_ablation_has_something_to_compare() -> None:
    for file in sorted((REPOSITORY / "conf" / "ablation").glob("*.yaml")):
        with pytest.raises(UserError, match=f"^\\+ablation={file.stem} sets "):
            ablations.check({}, {"ablation": file.stem}, REPOSITORY / "conf")


def test_files_of_all_kinds(tmp_path: Path) -> None:
    def refused(text: str, raw: dict[str, Any], **choices: str) -> str:
        (tmp_path / "ablation").mkdir(exist_ok=True)
        (tmp_path / "ablation" / "a.yaml").write_text(text)
        try:
            ablations.check(raw, {"ablation": "a", **choices}, tmp_path)
        except UserError as error:
            return str(error).partition(", so it is")[0]
        return ""

    assert refused("# @package model\nwidth: 3", {"model": {"width": 3}}) == ""
    assert refused("# @package model\nwidth: 3", {"model": {"width": 4}}).endswith(
        "model.width=3, and this run has model.width=4"
    )
    assert refused("width: 3", {"ablation": {"width": 3}}) == ""
    assert refused("# @package _global_\na: [1, 2]", {"a": [1, 2]}) == ""
    assert refused("# @package _global_\na: {}", {"a": {"b": 1}}).endswith("a={}, and this run has a={'b': 1}")
    assert refused("# @package _global_\na: 1", {"a": True}).endswith("a=1, and this run has a=true")
    assert refused("# @package _global_\na: ${b}", {"a": 7}) == ""
    assert refused("defaults:\n  - override /g/h: ${x}\n  - _self_", {}, **{"g/h": "y"}) == ""
    assert refused("defaults:\n  - optional /g/h: x", {}, **{"g/h": "y"}).endswith("h=x, and this run has h=y")
    assert refused("", {}) == ""
    ablations.check({}, {"ablation": "of_the_user"}, tmp_path)
    ablations.check({}, {}, tmp_path)


@pytest.mark.parametrize("name", ["gswm", "scalor", "space", "op3", "slot_attention"])
@pytest.mark.parametrize("scale", ["cpu", "smoke"])
def test_original_settings_stand_on_the_recipe_of_the_paper_s_scale(name: str, scale: str) -> None:
    with pytest.raises(UserError) as refused:
        compose_job(f"model={name}", "data=p2d", f"scale={scale}", f"+experiment={name}_original")
    assert str(refused.value) == (
        f"+experiment={name}_original changes the recipe of scale=paper, and this run has scale={scale}, whose sizes, "
        f"steps and schedules are others: leave out scale={scale}, or the experiment."
    )

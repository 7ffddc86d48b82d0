"""Every shipped file composes into a configuration that can be built."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from apex_lab.base.errors import UserError
from apex_lab.config.building import build_model
from apex_lab.config.composition import conf_dir
from tests.conftest import REPOSITORY, Ended, compose_job

NEEDED = {"video": ["data.path=videos"], "own_video": ["data=video", "data.path=videos"]}
"""What a choice cannot do without."""


def words(group: str) -> list[str]:
    return sorted(path.stem for path in (REPOSITORY / "conf" / group).glob("*.yaml") if path.stem[0] != "_")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("model", words("model"))
@pytest.mark.parametrize("scale", words("scale"))
def test_every_model_at_every_scale(model: str, scale: str) -> None:
    job = compose_job(f"model={model}", f"scale={scale}", "data=p2d")
    assert (job.choices["model"], job.choices["scale"]) == (model, scale)


def original_model(experiment: str) -> str:
    """The model of the experiment of an original publication; one publication may have several."""
    return next(model for model in words("model") if experiment.startswith(f"{model}_"))


@pytest.mark.parametrize("group", ["ablation", "experiment"])
def test_every_fragment(group: str) -> None:
    for word in words(group):
        # experiments of the original publications have clips as long as the paper's videos
        scale = "cpu" if group == "ablation" else "paper"
        model = original_model(word) if word.endswith("_original") else "apex"
        data = NEEDED["own_video"] if word == "own_video" else ["data=p2d"]
        job = compose_job(f"model={model}", f"scale={scale}", *data, f"+{group}={word}")
        assert job.choices[group] == word


def test_an_experiment_of_a_model_chooses_it(command: Callable[..., Ended]) -> None:
    for word in words("experiment"):
        if word.endswith("_original"):
            ended = command("train", f"+experiment={word}", "--cfg", "job")
            assert f"_target_: apex_lab.models.{original_model(word)}." in ended.out


@pytest.mark.parametrize("group", ["logger", "callbacks", "paths", "data"])
def test_every_choice(group: str) -> None:
    for word in words(group):
        assert compose_job(f"{group}={word}", *NEEDED.get(word, [])).choices[group] == word


def test_a_scale_is_the_size_that_it_says() -> None:
    paper = compose_job("scale=paper", "data=p2d", "model=apex").config
    assert (paper.data["image_size"], paper.data["frames"], paper.clips.batch_size) == (128, 20, 4)
    assert (paper.data["train"], paper.data["val"], paper.data["test"]) == (2000, 200, 200)
    assert paper.trainer.max_steps == 40000
    cpu = compose_job("scale=cpu", "data=p2d", "model=apex").config
    assert (cpu.data["image_size"], cpu.data["frames"]) == (64, 8)


def test_paper_is_the_default() -> None:
    defaults = yaml.safe_load((conf_dir() / "train.yaml").read_text())["defaults"]
    assert {"scale": "paper"} in defaults
    assert {"model": "apex"} in defaults


def test_weights_come_from_the_seed_alone() -> None:
    import torch

    first = build_model(compose_job("seed=1").config).state_dict()
    torch.rand(7)
    state = torch.get_rng_state()
    again = build_model(compose_job("seed=1").config).state_dict()
    assert torch.equal(torch.get_rng_state(), state)
    other = build_model(compose_job("seed=2").config).state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_conf_is_found_by_an_absolute_path() -> None:
    assert conf_dir().is_absolute()
    assert (conf_dir() / "evaluate.yaml").is_file()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("data.val=0",),
            "data.val = 0 leaves nothing to validate on: raise it, or set trainer.validation_interval=null",
        ),
        (("data.test=0",), "data.test = 0 leaves nothing to evaluate"),
        (
            ("data.val=0", "trainer.validation_interval=null", "evaluation.split=val"),
            "data.val = 0 leaves nothing to eval",
        ),
    ],
)
def test_nothing_to_look_at_is_refused(words: tuple[str, ...], told: str) -> None:
    with pytest.raises(UserError, match=told):
        compose_job("data=p2d", *words)
    assert compose_job("data=p2d", "data.val=0", "trainer.validation_interval=null").config.data["val"] == 0


def test_what_gives_no_number_for_a_step_is_no_schedule() -> None:
    with pytest.raises(UserError, match=r"^lr_scale is not a schedule, which gives a number for a step: "):
        compose_job("lr_scale={_target_: torch.nn.Linear, in_features: 1, out_features: 1}")

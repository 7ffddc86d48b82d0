"""Every model and every ablation: trains a step (if it trains at all), is scored, drawn and evaluated again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from apex_lab.benchmark.compare import twins_of
from apex_lab.benchmark.work import Workload, clip_length
from tests.conftest import REPOSITORY, Ended, compose_job

CONF = REPOSITORY / "conf"
SMALL = ("--config-dir", str(REPOSITORY / "tests" / "conf"), "data=squares", "scale=smoke", "trainer.max_steps=2")


def words(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize(
    "choice", [*(f"model={w}" for w in words("model")), *(f"+ablation={w}" for w in words("ablation"))]
)
def test_from_the_command_line_to_its_scores(
    choice: str, command: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    ended = command("train", *SMALL, choice, f"evaluation.pictures={int(choice == 'model=apex')}")
    assert ended.code == 0, ended.err
    ended = command("evaluate", f"checkpoint={the_run()}", "pictures=0")
    assert ended.code == 0, ended.err


@pytest.mark.parametrize("model", [word for word in words("model") if (CONF / "recipe" / word).is_dir()])
def test_the_naive_twin_trains_a_step_too(model: str) -> None:
    config = compose_job(f"model={model}", "scale=smoke", "data=p2d").config
    twins = twins_of(config)
    assert twins is not None
    if model == "space":  # its twin has glimpses of 32 pixels alone
        assert twins == {}
        return
    for twin in twins.values():
        work = Workload(config, torch.device("cpu"), 2, clip_length(config), twin)
        before = {name: p.detach().clone() for name, p in twin.named_parameters()}
        work.train()
        assert work.update.latest["train/loss"].isfinite()
        assert any(not torch.equal(p, before[name]) for name, p in twin.named_parameters())

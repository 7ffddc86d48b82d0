from __future__ import annotations

import time

import pytest
import torch

from apex_lab.base import progress
from apex_lab.config.building import build_model
from apex_lab.scene import Context, Scene
from apex_lab.training import estimate
from tests.conftest import compose_job
from tests.tiny import Layers


class Slow(Layers):
    """Takes 10 ms a frame."""

    def forward(self, video: torch.Tensor, context: Context) -> Scene:
        time.sleep(0.01 * video.shape[0] * video.shape[1])
        return super().forward(video, context)


def test_a_step_is_scaled_up_to_the_whole() -> None:
    config = compose_job("data.frames=20", "clips.batch_size=4", "trainer.max_steps=1000").config
    seconds = estimate.seconds_on_cpu(config, Slow())
    assert 0.01 * 20 * 4 * 1000 < seconds < 5 * 0.01 * 20 * 4 * 1000


def test_measuring_leaves_model_and_noise_alone() -> None:
    config = compose_job().config
    model = build_model(config)
    before, state = {k: v.clone() for k, v in model.state_dict().items()}, torch.get_rng_state()
    estimate.seconds_on_cpu(config, model)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    assert torch.equal(torch.get_rng_state(), state)


def test_only_what_is_long_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    paper, cpu = (compose_job(f"scale={scale}", "data=p2d", "model=apex").config for scale in ("paper", "cpu"))
    monkeypatch.setattr(estimate, "seconds_on_cpu", lambda *_: 30 * 86400.0)
    assert estimate.warning(cpu, Layers()) is None
    told = estimate.warning(paper, Layers())
    assert told is not None
    assert told.startswith("Training will take about 30 days on this CPU (an estimate")
    assert told.endswith("python -m apex_lab.train scale=cpu")
    monkeypatch.setattr(estimate, "seconds_on_cpu", lambda *_: 3600.0)
    assert estimate.warning(paper, Layers()) is None


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (3, "3 seconds"),
        (119, "119 seconds"),
        (150, "2.5 minutes"),
        (5400, "90 minutes"),
        (7200, "2.0 hours"),
        (86400, "24 hours"),
        (86400 * 31, "31 days"),
    ],
)
def test_durations_are_readable(seconds: float, words: str) -> None:
    assert progress.readable(seconds) == words

"""On a GPU: one step trains alike, however it is carried out."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from functools import cache

import pytest
import torch

from apex_lab.training.capture import Captured, SideStream
from apex_lab.training.optimizers import Muon
from apex_lab.training.update import WARMUP
from tests.conftest import REPOSITORY, TINY, Ended, compose_job
from tests.training.losses import STEPS

PRECISIONS = {
    "float32": ((), 1e-4),
    "tf32": (("trainer.matmul_precision=high",), 1e-3),
    "bf16": (("trainer.matmul_precision=high", "trainer.precision=bf16-mixed"), 1e-2),
}
"""Words, and how far losses may differ as a share."""
SLOWLY = {"smoke": (), "cpu": ("optimizer.lr=5e-5", "optimizer.adam_lr=1e-5")}
"""A hundredth of the recipe's rates: at the full ones, rounding alone makes losses differ by tenths within 20 steps."""
on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@cache
def losses(scale: str, frames: int, precision: str, mode: str, device: str = "cuda") -> tuple[float, ...]:
    words = ("model=apex", "data=p2d", f"scale={scale}", "trainer=auto", *SLOWLY[scale], *PRECISIONS[precision][0])
    command = [sys.executable, "-m", "tests.training.losses", device, str(frames), precision, mode]
    raw = json.dumps(compose_job(*words).raw)
    ended = subprocess.run(command, input=raw, capture_output=True, text=True, cwd=REPOSITORY)
    assert ended.returncode == 0, ended.stderr
    return tuple(json.loads(ended.stdout.splitlines()[-1]))


@pytest.mark.gpu
@on_a_gpu
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(("scale", "frames"), [("smoke", 3), ("cpu", 8)])
def test_a_captured_step_trains_as_an_eager_one(scale: str, frames: int, precision: str) -> None:
    expected, found = (losses(scale, frames, precision, mode) for mode in ("eager", "cuda graph"))
    assert found == pytest.approx(expected, rel=PRECISIONS[precision][1])


@pytest.mark.gpu
@pytest.mark.slow  # compiling takes minutes
@on_a_gpu
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(("scale", "frames"), [("smoke", 3), ("cpu", 2)])
@pytest.mark.parametrize("mode", ["compiled", "compiled cuda graph"])
def test_a_compiled_step_trains_as_an_eager_one(scale: str, frames: int, precision: str, mode: str) -> None:
    expected, found = (losses(scale, frames, precision, each) for each in ("eager", mode))
    assert found == pytest.approx(expected, rel=PRECISIONS[precision][1])


@pytest.mark.slow
def test_the_script_of_losses_runs_on_a_cpu() -> None:
    found = losses("smoke", 2, "float32", "eager", "cpu")
    assert len(found) == STEPS
    assert len(set(found)) == STEPS


@pytest.mark.gpu
@on_a_gpu
def test_a_replay_draws_what_its_seed_says() -> None:
    device = torch.device("cuda")
    side, given = SideStream(device), torch.zeros(1000, device=device)

    def work(x: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"a": x + torch.empty_like(x).normal_(), "b": x + torch.empty_like(x).uniform_()}

    for _ in range(WARMUP):
        with side.ordered():
            work(given)
    captured = Captured(work, given, side)
    for seed in (3, 4, 3):
        torch.manual_seed(seed)
        expected = work(given + seed)
        torch.manual_seed(seed)
        found = captured(given + seed)
        assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.gpu
@on_a_gpu
@pytest.mark.parametrize("graph", [False, True])
def test_a_whole_run(graph: bool, command: Callable[..., Ended]) -> None:
    words = ("optimizer._target_=apex_lab.training.optimizers.Muon", "trainer=gpu", f"trainer.cuda_graph={graph}")
    ended = command(
        "train", *TINY, *words, "trainer.max_steps=12", "trainer.validation_interval=5", "logger=tensorboard"
    )
    assert ended.code == 0, ended.err
    assert ended.out.count("validation:") == 3
    assert "test: " in ended.out


@pytest.mark.gpu
@on_a_gpu
def test_muon_multiplies_in_full_precision() -> None:
    weights = []
    for precision in ("highest", "high"):
        torch.manual_seed(0)
        weight = torch.nn.Parameter(torch.zeros(64, 256, device="cuda"))
        weight.grad = torch.outer(torch.randn(64), torch.randn(256)).cuda()
        torch.set_float32_matmul_precision(precision)
        try:
            Muon([weight]).step()
        finally:
            torch.set_float32_matmul_precision("highest")
        weights.append(weight.detach())
    torch.testing.assert_close(*weights, rtol=1e-6, atol=1e-7)

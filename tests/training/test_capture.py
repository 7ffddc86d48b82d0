"""That the step can be captured as a CUDA graph, as far as a CPU can tell (`tests.training.replayed`).

`torch.compiler.is_compiling` is made true, so that the code takes the way of a GPU.
"""

from __future__ import annotations

import contextlib
import weakref
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from apex_lab.benchmark.work import Workload
from apex_lab.training import update as updates
from apex_lab.training.capture import SideStream
from apex_lab.training.schedules import Constant, Linear
from apex_lab.training.update import WARMUP, Mode, WeightUpdate, named_parameters, remember_rates
from tests.conftest import TINY, compose_job, train_in
from tests.test_train import record, weights, without_speed
from tests.tiny import Layers
from tests.training.losses import where_all_counts
from tests.training.replayed import Refused, Replayed, traced

APEX = ("model=apex", "data=p2d", "trainer=cpu", "scale=smoke")
MOVING = tuple(
    f"schedule.{name}={{_target_: apex_lab.training.schedules.Linear, start: {start}, end: {end}, steps: 20}}"
    for name, start, end in (("temperature", 1.0, 0.5), ("carry", 0.3, 1.0), ("sigma_bg_scale", 1.5, 1.0))
)
"""Schedules that change at every step."""
MUON = ("optimizer._target_=apex_lab.training.optimizers.Muon",)
MERGES = (
    *("model.background.shadow=0.7", "model.merges=2", "model.piece_price=20", "model.hollow_price=10"),
    *("model.pixel_features=4", "model.whole_colours=true", "model.start_presence=0.9", "model.start_size=0.4"),
)
SCALED = ("lr_scale={_target_: apex_lab.training.schedules.Linear, start: 1.0, end: 0.5, steps: 20}",)
SMOKE = (*APEX, *MOVING, *SCALED)
P2D = ("model=apex", "data=p2d", "trainer=cpu", "scale=cpu")
"""The recipe that results on P2D come from: merges, shadows, refinement, loose windows and Muon."""
BF16 = ("trainer.precision=bf16-mixed",)
CPU = torch.device("cpu")
FIRST = (0, 1, 2, 3, 4)
THROUGHOUT = (0, 700, 1800, 5088, 600)
"""Numbers of steps that P2D is replayed at: captured where all counts, then without shadows and refinement."""


@pytest.fixture
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(updates, "Captured", Replayed)


def workload(*words: str, device: torch.device = CPU, mode: Mode = "eager") -> Workload:
    """One clip of two frames, the fewest in which objects are carried on, where all counts."""
    config = compose_job(*words).config
    made = Workload(config, device, 1, 2, mode=mode)
    made.update.step = where_all_counts(made, config)
    made.update.write(made.optimizer)
    return made


def clips(like: Tensor, step: int) -> Tensor:
    return torch.randint(0, 256, like.shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(step))


def rows(made: Workload, steps: tuple[int, ...]) -> list[dict[str, float]]:
    """Values of each step, on other clips at every other one."""
    assert made.optimizer is not None
    found = []
    made.model.train()
    with torch.random.fork_rng(devices=[]):
        for i, step in enumerate(steps):
            made.update.step = step
            made.update(clips(made.video, i) if i % 2 else made.video, made.optimizer)
            found.append({name: value.item() for name, value in made.update.latest.items()})
    return found


@pytest.mark.parametrize(
    ("words", "steps", "tolerance"),
    [
        (SMOKE, FIRST, 1e-4),
        ((*SMOKE, *MUON), FIRST, 1e-4),
        ((*SMOKE, *MERGES), FIRST, 1e-4),
        ((*SMOKE, *BF16), FIRST, 2e-3),
        (P2D, THROUGHOUT, 1e-4),
    ],
    ids=["Adam", "Muon", "merges and shadows", "bf16", "P2D"],
)
@pytest.mark.usefixtures("replayed", "as_on_a_gpu")
def test_a_replayed_step_of_apex_trains_as_an_eager_one(
    words: tuple[str, ...], steps: tuple[int, ...], tolerance: float
) -> None:
    assert len(steps) == WARMUP + 2
    eager, graph = workload(*words), workload(*words, mode="cuda graph")
    for expected, found in zip(rows(eager, steps), rows(graph, steps), strict=True):
        assert found == pytest.approx(expected, rel=tolerance)
        assert found["train/loss"] == pytest.approx(expected["train/loss"], rel=tolerance / 100)


def test_all_counts_at_the_steps_that_are_traced() -> None:
    made = workload(*P2D)
    values = {**made.update.schedules.tensors(), **made.update.weights.tensors()}
    assert all(values[name] > 0 for name in ("shadow", "refinement", "carry", "loose_windows", "kl_what"))
    assert made.update.step in THROUGHOUT
    assert workload(*SMOKE).update.step == 0


def layers(mode: Mode, captured: bool) -> list[float]:
    torch.manual_seed(5)
    schedules, weights = {"noise": Linear(1.0, 0.1, 10)}, {"error": Constant(1.0), "spread": Linear(0.0, 1.5, 10)}
    made = WeightUpdate(Layers(), schedules, weights, Linear(1.0, 0.1, 10), 1.0, seed=3, mode=mode)
    optimizer = remember_rates(torch.optim.RMSprop(named_parameters(made.model), lr=1e-2), captured)
    found = []
    for step in range(20):
        shape = (4, 2, 3, 16, 12 if 8 <= step < 15 else 16)  # a second graph, and the first shape's once more
        made(clips(torch.empty(shape), step), optimizer)
        found.append(made.latest["train/loss"].item())
    return found


@pytest.mark.usefixtures("replayed", "as_on_a_gpu")
def test_twenty_steps_in_two_shapes() -> None:
    assert layers("cuda graph", captured=True) == pytest.approx(layers("eager", captured=False), rel=1e-5)


@pytest.mark.usefixtures("as_on_a_gpu")
def test_the_graph_of_one_shape_is_held_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    there: weakref.WeakSet[Replayed] = weakref.WeakSet()
    others: list[int] = []

    class Noted(Replayed):
        def __init__(self, work: Any, given: Tensor, side: SideStream) -> None:
            others.append(len(there))
            super().__init__(work, given, side)
            there.add(self)

    monkeypatch.setattr(updates, "Captured", Noted)
    layers("cuda graph", captured=True)
    assert others == [0, 0, 0]  # three captures, each without another graph beside it


@pytest.mark.usefixtures("replayed", "as_on_a_gpu")
def test_a_learning_rate_that_is_no_tensor_would_be_noticed() -> None:
    assert layers("cuda graph", captured=False) != pytest.approx(layers("eager", captured=False), rel=1e-5)


def always_the_same(made: Workload, steps: tuple[int, int, int] = (1, 2, 40)) -> int:
    """Other clips, noise and schedules, frames without any object: the same operations on the same shapes.

    Schedules and loss weights stay where they are in memory.

    Returns:
        How many operations.
    """
    update, optimizer = made.update, made.optimizer
    assert optimizer is not None

    def scheduled() -> list[Tensor]:
        return [tensor.detach() for each in (update.schedules, update.weights) for tensor in each.tensors().values()]

    held = scheduled()  # kept, or what is made anew could lie where the old one lay

    def step(video: Tensor, number: int) -> list[Any]:
        update.step = number
        update.write(optimizer)
        torch.manual_seed(number)
        noise = updates.RankNoise(len(video), 0, len(video))
        assert [tensor.data_ptr() for tensor in scheduled()] == [tensor.data_ptr() for tensor in held]
        return traced(lambda: update._work(video, optimizer, noise, Tensor.backward, optimizer.step))

    with torch.random.fork_rng(devices=[]):
        made.train()  # makes the optimiser's state
        expected = step(made.video, steps[0])
        for number, video in zip(steps[1:], (clips(made.video, 0), torch.full_like(made.video, 128)), strict=True):
            assert step(video, number) == expected
    return len(expected)


@pytest.mark.parametrize(
    "words",
    [
        MUON,
        BF16,
        (*MERGES, *BF16),
        MERGES,
        pytest.param(("+ablation=image_stn",), marks=pytest.mark.slow),
        pytest.param(("+ablation=gaussian_scalor_norm",), marks=pytest.mark.slow),
    ],
    ids=["Muon", "bf16", "merges and shadows in bf16", "merges and shadows", "image_stn", "gaussian_scalor_norm"],
)
@pytest.mark.usefixtures("as_on_a_gpu")
def test_the_step_is_the_same_whatever_it_sees(words: tuple[str, ...]) -> None:
    assert always_the_same(workload(*SMOKE, *words, mode="cuda graph")) > 2000


@pytest.mark.parametrize("words", [(), pytest.param(BF16, marks=pytest.mark.slow)], ids=["float32", "bf16"])
@pytest.mark.usefixtures("as_on_a_gpu")
def test_the_step_of_p2d_too(words: tuple[str, ...]) -> None:
    """Where all counts, without shadows and refinement, and in between."""
    made = workload(*P2D, *words, mode="cuda graph")
    assert always_the_same(made, (made.update.step, 600, 1800)) > 2000


@pytest.mark.slow
@pytest.mark.parametrize("model", ["space", "scalor", "gswm", "slot_attention", "op3"])
@pytest.mark.usefixtures("as_on_a_gpu")
def test_the_step_of_other_models_too(model: str) -> None:
    config = compose_job(f"model={model}", "data=sprites", "scale=smoke", "trainer=cpu").config
    assert always_the_same(Workload(config, CPU, 2, 3, mode="cuda graph")) > 500


@pytest.mark.parametrize("words", [SMOKE, (*SMOKE, *MERGES), P2D], ids=["paper", "merges and shadows", "P2D"])
@pytest.mark.usefixtures("as_on_a_gpu")
def test_inference_is_the_same_whatever_it_sees(words: tuple[str, ...]) -> None:
    made = workload(*words)

    def infer(video: Tensor) -> list[Any]:
        return traced(lambda: made.predictor({"video": video, "name": ["a video"]}))

    expected = infer(made.video)
    assert len(expected) > 500
    assert infer(torch.full_like(made.video, 128)) == expected


@pytest.mark.parametrize("waits", [lambda x: x.sum().item(), lambda x: x[x > 0], lambda x: torch.tensor(3.0) + x])
def test_what_waits_for_the_device_is_refused(waits: Any) -> None:
    with pytest.raises(Refused):
        traced(lambda: waits(torch.ones(3)))


class OnOneDevice(TorchDispatchMode):
    """Raises where a tensor of the host comes into a computation on the device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        results = func(*args, **(kwargs or {}))
        for tensor in tree_leaves((args, kwargs, results)):
            if isinstance(tensor, Tensor):
                assert tensor.device.type == "meta", f"{func} of a tensor on the {tensor.device.type}"
        return results


@pytest.mark.parametrize(
    "words",
    [APEX, (*APEX, *MUON), (*APEX, *MERGES), P2D],
    ids=["Adam", "Muon", "merges and shadows", "P2D"],
)
@pytest.mark.usefixtures("as_on_a_gpu")
def test_nothing_of_the_step_lies_on_the_host(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """The device `meta` has shapes without numbers: whatever asks for a number raises."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # there is none for `meta`
    made = workload(*words, device=torch.device("meta"), mode="cuda graph")
    assert made.optimizer is not None
    made.model.train()
    with OnOneDevice():
        made.update(made.video, made.optimizer)
    assert made.update.latest["train/loss"].device.type == "meta"
    with pytest.raises(AssertionError, match="on the cpu"), OnOneDevice():
        _ = made.video.float() * torch.ones(())


@pytest.mark.usefixtures("replayed")
def test_a_whole_run_by_graph(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """Through Lightning, with validation and checkpoints between, and with a stop after the first steps."""
    words = (*TINY, *MUON, "trainer=cpu", "trainer.max_steps=12", "trainer.validation_interval=5")
    runs = []
    for name in ("eager", "graph"):
        if name == "graph":
            monkeypatch.setattr("apex_lab.training.fit.mode_of", lambda *_: "cuda graph")
            train_in(tmp_path, *words, f"paths.outputs={name}", "trainer.max_minutes=1e-6")  # one step
        train_in(tmp_path, *words, f"paths.outputs={name}")
        runs.append(next((tmp_path / name).glob("*/seed_0")))
    assert [record(run)["steps"] for run in runs] == [12, 12]
    for a, b in zip(*(weights(run).values() for run in runs), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    for expected, found in zip(*map(without_speed, runs), strict=True):
        assert {k: float(v) for k, v in found.items() if v} == pytest.approx(
            {k: float(v) for k, v in expected.items() if v}, rel=1e-4, abs=1e-6
        )

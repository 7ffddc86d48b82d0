"""The step keeps everything that depends on progress in tensors that a captured graph sees."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from apex_lab.scene import Context, Scene
from apex_lab.training.schedules import Constant, Linear
from apex_lab.training.update import Mode, Scheduled, WeightUpdate, named_parameters, remember_rates
from tests.tiny import Layers

WEIGHTS = {"error": Constant(1.0), "spread": Linear(0.5, 1.5, 10)}


def batch(step: int, device: str = "cpu") -> torch.Tensor:
    generator = torch.Generator().manual_seed(step)
    return torch.randint(0, 256, (4, 2, 3, 16, 16), dtype=torch.uint8, generator=generator).to(device)


def update(device: str = "cpu", mode: Mode = "eager", step: int = 0, precision: int | str = 32) -> WeightUpdate:
    torch.manual_seed(5)
    schedules, scale = {"noise": Linear(1.0, 0.1, 10)}, Linear(1.0, 0.5, 10)
    made = WeightUpdate(Layers(), schedules, WEIGHTS, scale, 1.0, seed=3, precision=precision, step=step, mode=mode)
    return made.to(device)


def losses(made: WeightUpdate, steps: int, device: str = "cpu") -> list[float]:
    optimizer = torch.optim.Adam(named_parameters(made.model), lr=1e-3, capturable=made.mode == "cuda graph")
    remember_rates(optimizer, made.mode == "cuda graph")
    found = []
    for step in range(steps):
        made(batch(step, device), optimizer)
        found.append(float(made.latest["train/loss"]))
    return found


def test_values_are_written_into_the_same_tensors() -> None:
    values = Scheduled({"a": Linear(0.0, 1.0, 10), "b": Constant(3.0)})
    before = values.tensors()
    values.write(5)
    after = values.tensors()
    assert [float(after[name]) for name in ("a", "b")] == [0.5, 3.0]
    assert all(before[name].data_ptr() == after[name].data_ptr() for name in before)
    assert not values.state_dict()  # they follow from the step, so no checkpoint holds them


@pytest.mark.parametrize(
    ("weights", "unused"),
    [({}, {"windows"}), ({"windows": Constant(0.0)}, {"windows"}), ({"windows": Linear(0.0, 1.0, 10)}, set())],
    ids=["not named", "zero", "zero at first"],
)
def test_the_model_is_told_which_terms_nobody_reads(weights: dict[str, Constant | Linear], unused: set[str]) -> None:
    found = []

    class Model(Layers):
        optional_terms = ("windows",)

        def forward(self, video: torch.Tensor, context: Context) -> Scene:
            found.append(context.unused)
            scene = super().forward(video, context)
            return replace(scene, terms=scene.terms | {"windows": torch.zeros(len(video))})

    made = WeightUpdate(Model(), {"noise": Constant(1.0)}, WEIGHTS | weights)
    losses(made, 1)
    assert found == [unused]


def test_learning_rates_are_set_before_each_update() -> None:
    made = update()
    optimizer = remember_rates(torch.optim.Adam(named_parameters(made.model), lr=1e-3))
    rates = []
    for step in range(3):
        made(batch(step), optimizer)
        rates.append(optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3 * (1 - 0.05 * step) for step in range(3)])


def test_learning_rates_of_a_captured_step_are_tensors_written_in_place() -> None:
    made = update()
    optimizer = remember_rates(torch.optim.SGD(named_parameters(made.model), lr=1e-3), captured=True)
    rate = optimizer.param_groups[0]["lr"]
    made.step = 10
    made.write(optimizer)
    assert optimizer.param_groups[0]["lr"] is rate
    assert float(rate) == pytest.approx(5e-4)


def test_two_ranks_make_the_gradient_of_one() -> None:
    whole, halves = update(), [update(), update()]
    nothing = torch.optim.SGD(named_parameters(whole.model), lr=0.0)
    whole(batch(0), remember_rates(nothing))
    gradients = []
    for rank, made in enumerate(halves):
        made.clip_norm = float("inf")
        part = batch(0)[2 * rank : 2 * rank + 2]
        made(part, remember_rates(torch.optim.SGD(named_parameters(made.model), lr=0.0)), rank, 2)
        gradients.append([p.grad for p in made.model.parameters()])
    whole.clip_norm = float("inf")
    whole.step = 0
    whole(batch(0), remember_rates(nothing))
    for one, a, b in zip(whole.model.parameters(), *gradients, strict=True):
        assert a is not None
        assert b is not None
        torch.testing.assert_close(one.grad, (a + b) / 2, rtol=1e-4, atol=1e-6)


def test_half_precision_stays_close() -> None:
    full, half = losses(update(), 5), losses(update(precision="bf16-mixed"), 5)
    assert half == pytest.approx(full, rel=0.02)
    assert half != full


def test_backward_and_update_are_outside_autocast() -> None:
    """Lightning opens it around the whole step."""
    made, seen = update(precision="bf16-mixed"), []

    def backward(loss: torch.Tensor) -> None:
        seen.append(torch.is_autocast_enabled("cpu"))
        loss.backward()

    optimizer = remember_rates(torch.optim.SGD(named_parameters(made.model), lr=0.0))
    with torch.autocast("cpu", torch.bfloat16):
        made(batch(0), optimizer, backward=backward, update=lambda: seen.append(torch.is_autocast_enabled("cpu")))
    assert seen == [False, False]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_captured_step_trains_as_an_eager_one() -> None:
    eager, captured = losses(update("cuda"), 20, "cuda"), losses(update("cuda", "cuda graph"), 20, "cuda")
    assert captured == pytest.approx(eager, rel=1e-3)

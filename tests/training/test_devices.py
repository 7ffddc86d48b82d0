"""What depends on the device: precision of products, kinds of optimisers, and states that go from one to another."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor, nn
from torch.optim import SGD, Adam, Optimizer, RMSprop

from apex_lab.config.upgrades import fingerprint
from apex_lab.nn.precision import full_products
from apex_lab.runs import provenance
from apex_lab.training.composite import Composite
from apex_lab.training.devices import _fused, set_matmul_precision
from apex_lab.training.optimizers import Muon, all_orthogonalised
from apex_lab.training.update import remember_rates
from tests.conftest import Ended, compose_job
from tests.test_train import without_speed


class Elsewhere(Tensor):
    """A tensor that NumPy cannot see, as on a GPU, and so is what is computed from it."""

    def numpy(self, **_: Any) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def cpu(self, *_: Any, **__: Any) -> Tensor:
        return self.as_subclass(Tensor)


GPU, CPU = torch.device("cuda"), torch.device("cpu")


@pytest.fixture
def products() -> Iterator[Callable[[], str]]:
    """The precision of products, set back afterwards."""
    yield torch.get_float32_matmul_precision
    torch.set_float32_matmul_precision("highest")


def test_products_of_a_cpu_stay_in_full_precision(products: Callable[[], str]) -> None:
    set_matmul_precision(CPU, "medium")
    assert products() == "highest"


def test_products_of_a_gpu_are_as_asked_for(products: Callable[[], str], monkeypatch: pytest.MonkeyPatch) -> None:
    set_matmul_precision(GPU, "high")
    assert products() == "high"
    with full_products(GPU):
        assert products() == "highest"
    assert products() == "high"
    with pytest.raises(ZeroDivisionError), full_products(GPU):
        _ = 1 / 0
    assert products() == "high"
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    assert provenance.hardware(GPU)["matmul_precision"] == "high"  # in run.json
    assert "matmul_precision" not in provenance.hardware(CPU)


@pytest.mark.parametrize("logger", ["csv", "tensorboard"])
def test_batches_of_training_and_validation_may_lie_on_a_gpu(
    logger: str, train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("trainer=cpu", "trainer.validation_interval=3", f"logger={logger}")
    assert train(*words, "paths.outputs=plain").code == 0
    real = SingleDeviceStrategy.batch_to_device

    def moved(self: SingleDeviceStrategy, batch: Any, *args: Any, **kwargs: Any) -> Any:
        batch = real(self, batch, *args, **kwargs)
        return {key: x.as_subclass(Elsewhere) if isinstance(x, Tensor) else x for key, x in batch.items()}

    monkeypatch.setattr(SingleDeviceStrategy, "batch_to_device", moved)
    ended = train(*words)
    assert ended.code == 0, ended.err
    [plain] = Path("plain").glob("*/seed_0")
    assert without_speed(the_run()) == without_speed(plain)


def test_only_another_precision_is_another_run() -> None:
    job, other = compose_job(), compose_job("trainer.matmul_precision=high")
    assert job.config.trainer.matmul_precision == "highest"  # PyTorch's default: what all runs had before the key
    assert fingerprint(job.raw) != fingerprint(other.raw)
    older = copy.deepcopy(job.raw)
    del older["trainer"]["matmul_precision"]
    assert fingerprint(job.raw) == fingerprint(older)


def tf32(x: Tensor) -> Tensor:
    """Rounded to 10 bits of mantissa."""
    return ((x.contiguous().view(torch.int32) + 0x1000) & ~0x1FFF).view(torch.float32)


def test_tf32_does_not_carry_the_orthogonalisation(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    momentum = torch.outer(torch.randn(64), torch.randn(256)) + 1e-3 * torch.randn(64, 256)
    exact = all_orthogonalised([momentum.double()])[0]
    error = (all_orthogonalised([momentum])[0] - exact).norm() / exact.norm()
    assert error < 1e-3
    bmm, baddbmm = torch.bmm, torch.baddbmm
    monkeypatch.setattr(torch, "bmm", lambda x, y: bmm(tf32(x), tf32(y)))
    monkeypatch.setattr(torch, "baddbmm", lambda x, y, z, **kw: baddbmm(x, tf32(y), tf32(z), **kw))
    assert (all_orthogonalised([momentum])[0] - exact).norm() / exact.norm() > 0.1


def test_optimisers_are_fused_on_a_gpu_unless_something_else_was_asked_for() -> None:
    weights = [nn.Parameter(torch.ones(2))]
    for optimizer, asked in (
        (Adam(weights), None),
        (SGD(weights), None),
        (Adam(weights, fused=False), False),
        (Adam(weights, foreach=True), None),
    ):
        assert _fused(optimizer, CPU) is asked
        free = asked is None and not optimizer.defaults["foreach"]
        assert _fused(optimizer, GPU) is (True if free else asked)


def composite(parameters: list[nn.Parameter]) -> Composite:
    named = list(zip(("a.weight", "b.weight", "c.weight"), parameters, strict=True))
    groups: dict[str, dict[str, Any]] = {
        "first": {"parameters": "a", "optimizer": lambda params: RMSprop(params, lr=1e-3)},
        "others": {"parameters": ["b", "c"], "optimizer": lambda params: Adam(params, lr=1e-3)},
    }
    return Composite(named, groups)


@pytest.mark.parametrize("make", [Adam, RMSprop, Muon, composite])
def test_a_state_of_a_captured_run_goes_on_on_a_cpu(make: Callable[[list[nn.Parameter]], Optimizer]) -> None:
    def weights() -> list[nn.Parameter]:
        return [nn.Parameter(torch.full((3, 4), 0.5)) for _ in range(3)]

    def steps(parameters: list[nn.Parameter], optimizer: Optimizer, numbers: range) -> None:
        for number in numbers:
            for weight in parameters:
                weight.grad = torch.randn(3, 4, generator=torch.Generator().manual_seed(number))
            optimizer.step()

    whole, first = weights(), weights()
    steps(whole, remember_rates(make(whole)), range(6))
    optimizer = remember_rates(make(first))
    steps(first, optimizer, range(3))
    state = copy.deepcopy(optimizer.state_dict())
    for one in [state] if "param_groups" in state else state.values():
        for group in one["param_groups"]:
            group["lr"] = torch.tensor(group["lr"])
            group.update({key: True for key in ("capturable", "fused", "foreach") if key in group})
    second = [nn.Parameter(weight.detach().clone()) for weight in first]
    going_on = make(second)
    going_on.load_state_dict(state)
    remember_rates(going_on)
    assert all(type(group["lr"]) is float for group in going_on.param_groups)
    for key in ("capturable", "fused", "foreach"):
        assert not any(group.get(key) for group in going_on.param_groups), key
    steps(second, going_on, range(3, 6))
    for a, b in zip(whole, second, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)

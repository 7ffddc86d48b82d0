"""Muon against a singular value decomposition, its formula written out, and PyTorch's own optimisers."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from apex_lab.base.errors import UserError
from apex_lab.config import components
from apex_lab.training.optimizers import QUINTIC, Muon, all_orthogonalised, is_matrix, orthogonalised
from apex_lab.training.update import remember_rates


def test_orthogonalised_keeps_singular_vectors_and_maps_singular_values_by_the_quintic() -> None:
    for shape in [(5, 9), (9, 5), (6, 6)]:
        x = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        u, s, v = torch.linalg.svd(x, full_matrices=False)
        mapped = s / s.norm()
        a, b, c = QUINTIC
        for _ in range(5):
            mapped = a * mapped + b * mapped**3 + c * mapped**5
        torch.testing.assert_close(orthogonalised(x), u @ mapped.diag() @ v, rtol=1e-9, atol=1e-9)
        assert mapped.min() > 0.6
        assert mapped.max() < 1.3


def test_orthogonalised_is_exact_enough_in_float32_where_gradients_are_nearly_of_low_rank() -> None:
    generator = torch.Generator().manual_seed(3)
    u, _ = torch.linalg.qr(torch.randn(64, 64, dtype=torch.float64, generator=generator))
    v, _ = torch.linalg.qr(torch.randn(288, 64, dtype=torch.float64, generator=generator))
    x = u @ torch.logspace(0, -8, 64, dtype=torch.float64).diag() @ v.T
    torch.testing.assert_close(orthogonalised(x.float()).double(), orthogonalised(x), rtol=0.0, atol=1e-2)


def test_matrices_that_are_iterated_together_do_not_see_each_other() -> None:
    g = torch.Generator().manual_seed(6)
    shapes = [(4, 9), (9, 4), (6, 6), (4, 4), (12, 6), (1, 5), (4, 30)]
    matrices = [10.0**i * torch.randn(shape, dtype=torch.float64, generator=g) for i, shape in enumerate(shapes)]
    matrices.append(torch.zeros(6, 7, dtype=torch.float64))
    together = all_orthogonalised(matrices)
    for each, alone in zip(together, matrices, strict=True):
        torch.testing.assert_close(each, orthogonalised(alone), rtol=1e-10, atol=1e-12)


def test_orthogonalised_does_not_depend_on_the_scale_and_leaves_zeros() -> None:
    x = torch.randn(4, 7, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(orthogonalised(1e6 * x), orthogonalised(1e-6 * x))
    assert orthogonalised(torch.zeros(3, 4)).eq(0).all()


def test_weights_whose_gradients_vanish_come_to_rest() -> None:
    weight = nn.Parameter(torch.randn(64, 288, generator=torch.Generator().manual_seed(4)))
    optimizer = Muon([weight])
    weight.grad = 1e-3 * torch.randn(64, 288, generator=torch.Generator().manual_seed(5))
    optimizer.step()
    weight.grad = torch.zeros_like(weight)
    for _ in range(600):
        optimizer.step()
    before = weight.detach().clone()
    for _ in range(2000):
        optimizer.step()
    assert (weight - before).abs().max() < 1e-4
    assert orthogonalised(1e-25 * torch.randn(64, 288)).abs().max() < 1e-12


def test_too_many_iterations_are_refused() -> None:
    node = {"_target_": "apex_lab.training.optimizers.Muon", "iterations": 9}
    with pytest.raises(UserError, match=r"optimizer\.iterations = 9 is wrong"):
        components.check(node, "optimizer", supplied=["params"])


def test_which_weights_are_matrices() -> None:
    assert is_matrix(torch.zeros(3, 4))
    assert is_matrix(torch.zeros(8, 3, 7, 7))
    for shape in [(5,), (), (3, 64, 64), (1, 9), (9, 1), (1, 8, 3, 3)]:
        assert not is_matrix(torch.zeros(shape)), shape


def test_a_convolution_moves_by_its_orthogonalised_nesterov_momentum() -> None:
    weight = nn.Parameter(torch.randn(6, 2, 1, 1, dtype=torch.float64))
    optimizer = Muon([weight], lr=0.1, momentum=0.8)
    expected, momentum = weight.detach().clone(), torch.zeros(6, 2, dtype=torch.float64)
    for i in range(3):
        grad = torch.randn(weight.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(i))
        weight.grad = grad.clone()
        optimizer.step()
        momentum = 0.8 * momentum + 0.2 * grad.view(6, 2)
        expected -= 0.1 * math.sqrt(3) * orthogonalised(0.2 * grad.view(6, 2) + 0.8 * momentum).view_as(weight)
        torch.testing.assert_close(weight.detach(), expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(weight.grad, grad)  # the gradient is the caller's


def test_updates_inside_autocast_are_those_in_full_precision() -> None:
    """Lightning makes a step inside autocast where precision is bf16-mixed."""
    moved = []
    for half in (False, True):
        torch.manual_seed(0)
        weight = nn.Parameter(torch.randn(8, 16))
        optimizer = Muon([weight], lr=0.1)
        for _ in range(3):
            weight.grad = torch.randn(8, 1) @ torch.randn(1, 16)
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                optimizer.step()
        moved.append(weight.detach())
    torch.testing.assert_close(*moved, rtol=0, atol=0)


def test_a_linear_map_moves_as_with_pytorchs_muon() -> None:
    ours = nn.Parameter(torch.randn(4, 6, generator=torch.Generator().manual_seed(2)))
    theirs = nn.Parameter(ours.detach().clone())
    a = Muon([ours], lr=0.1)
    b = torch.optim.Muon([theirs], lr=0.1, weight_decay=0.0, momentum=0.95)
    start = ours.detach().clone()
    for i in range(3):
        grad = torch.randn(4, 6, generator=torch.Generator().manual_seed(10 + i))
        ours.grad, theirs.grad = grad.clone(), grad.clone()
        a.step()
        b.step()
    # PyTorch's runs in bfloat16
    torch.testing.assert_close(ours - start, theirs - start, rtol=0.0, atol=0.01)


def test_everything_else_moves_as_with_adam() -> None:
    ours = [nn.Parameter(torch.randn(7)), nn.Parameter(torch.randn(3, 4, 4)), nn.Parameter(torch.randn(1, 5))]
    theirs = copy.deepcopy(ours)
    a, b = Muon(ours, adam_lr=0.02), torch.optim.Adam(theirs, lr=0.02)
    for _ in range(5):
        for x, y in zip(ours, theirs, strict=True):
            x.grad = torch.randn_like(x)
            y.grad = x.grad.clone()
        a.step()
        b.step()
    for x, y in zip(ours, theirs, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)


def small(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Conv2d(3, 8, 3), nn.GroupNorm(2, 8), nn.ReLU(), nn.Flatten(), nn.Linear(8 * 4, 2))


def descend(model: nn.Module, optimizer: Optimizer, steps: range) -> list[float]:
    losses = []
    for i in steps:
        x = torch.randn(16, 3, 4, 4, generator=torch.Generator().manual_seed(i))
        loss = (model(x) - x.flatten(1)[:, :2]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


def test_it_learns() -> None:
    model = small()
    losses = descend(model, Muon(model.parameters()), range(200))
    assert sum(losses[-20:]) < 0.5 * sum(losses[:20])


def test_going_on_from_its_state_is_as_if_nothing_had_happened() -> None:
    whole = small()
    descend(whole, Muon(whole.parameters()), range(8))
    first = small()
    optimizer = Muon(first.parameters())
    descend(first, optimizer, range(4))
    second = small(1)
    second.load_state_dict(first.state_dict())
    going_on = Muon(second.parameters())
    going_on.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    descend(second, going_on, range(4, 8))
    for x, y in zip(whole.parameters(), second.parameters(), strict=True):
        assert torch.equal(x, y)


def test_weights_without_a_gradient_stay() -> None:
    weight, idle = nn.Parameter(torch.ones(2, 2)), nn.Parameter(torch.ones(2, 2))
    optimizer = Muon([weight, idle])
    weight.grad = torch.eye(2)
    optimizer.step()
    assert idle.eq(1).all()
    assert not weight.eq(1).all()


def test_a_closure_is_called_with_gradients_on() -> None:
    weight = nn.Parameter(torch.ones(3))
    optimizer = Muon([weight])

    def closure() -> Tensor:
        loss = weight.square().sum()
        loss.backward()
        return loss

    assert optimizer.step(closure).item() == 3
    assert weight.lt(1).all()


def test_a_learning_rate_on_the_device_makes_the_same_steps() -> None:
    number, tensor = small(), small()
    descend(number, Muon(number.parameters()), range(4))
    descend(tensor, remember_rates(Muon(tensor.parameters()), captured=True), range(4))
    for x, y in zip(number.parameters(), tensor.parameters(), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_it_moves_weights_on_a_gpu_as_on_the_cpu() -> None:
    here, there = small(), small().cuda()
    a, b = Muon(here.parameters()), Muon(there.parameters())
    for i in range(3):
        for x, y in zip(here.parameters(), there.parameters(), strict=True):
            x.grad = torch.randn(x.shape, generator=torch.Generator().manual_seed(i))
            y.grad = x.grad.cuda()
        a.step()
        b.step()
    for x, y in zip(here.parameters(), there.parameters(), strict=True):
        torch.testing.assert_close(x, y.cpu(), rtol=1e-3, atol=1e-3)

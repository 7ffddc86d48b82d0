"""Gradients of weights that are made once for all uses are those of autograd."""

from __future__ import annotations

import contextlib

import pytest
import torch
from torch import Tensor, nn

from apex_lab.nn.shared import gathered_gradients


class Loop(nn.Module):
    """A loop with every kind of layer, of which one use has no gradient and another layer is never used."""

    def __init__(self) -> None:
        super().__init__()
        self.cell, self.plain_cell = nn.GRUCell(5, 4), nn.GRUCell(4, 4, bias=False)
        self.head, self.no_bias = nn.Linear(4, 3), nn.Linear(3, 5, bias=False)
        self.conv = nn.Conv2d(1, 2, 3, stride=2, padding=1)
        self.conv_no_bias = nn.Sequential(nn.Conv2d(2, 2, 3, padding=1, bias=False), nn.GroupNorm(1, 2), nn.ReLU(True))
        self.unused = nn.Linear(2, 2)

    def forward(self, images: Tensor, rows: tuple[int, ...] = (3, 2, 3)) -> Tensor:
        state, found = torch.zeros(3, 4, dtype=images.dtype), []
        for n in rows:
            maps = self.conv_no_bias(self.conv(images[:n] + state[:n, :1, None, None]))
            seen = self.no_bias(self.head(state[:n].unflatten(0, (1, n)))).squeeze(0)
            new = self.cell(seen + maps.mean((1, 2, 3))[:, None], state[:n])
            state = torch.cat([self.plain_cell(new, new), state[n:]])
            found.append(self.head(state).square().sum())
        self.head(state)  # its result is not used
        return torch.stack(found).sum() + state.sum()


def gradients(gathered: bool, images: Tensor, twice: bool = False) -> tuple[Tensor, dict[str, Tensor | None]]:
    torch.manual_seed(0)
    loop = Loop().double()
    with gathered_gradients(loop, like=images) if gathered else contextlib.nullcontext():
        loss = loop(images)
    loss.backward(retain_graph=twice)
    if twice:
        loss.backward()
    assert not any("forward" in vars(layer) for layer in loop.modules())
    return loss.detach(), {name: weight.grad for name, weight in loop.named_parameters()} | {"images": images.grad}


@pytest.mark.parametrize("twice", [False, True])
def test_gradients_are_those_of_autograd(twice: bool) -> None:
    torch.manual_seed(1)
    images = torch.randn(3, 1, 6, 6, dtype=torch.float64)
    (loss, found), (expected, wanted) = (
        gradients(gathered, images.clone().requires_grad_(), twice) for gathered in (True, False)
    )
    torch.testing.assert_close(loss, expected, rtol=1e-12, atol=1e-12)
    for name, gradient in wanted.items():
        if gradient is None:
            assert found[name] is None, name
        else:
            torch.testing.assert_close(found[name], gradient, rtol=1e-10, atol=1e-12, msg=name)


def test_some_gradients_alone() -> None:
    torch.manual_seed(1)
    images = torch.randn(3, 1, 6, 6, dtype=torch.float64, requires_grad=True)
    loop = Loop().double()
    with gathered_gradients(loop, like=images):
        loss = loop(images)
    (before,) = torch.autograd.grad(loss, images, retain_graph=True)
    loss.backward()
    found = {name: weight.grad for name, weight in loop.named_parameters()}
    loop.zero_grad()
    loop(images).backward()
    for name, weight in loop.named_parameters():
        if weight.grad is not None:
            torch.testing.assert_close(found[name], weight.grad, rtol=1e-10, atol=1e-12, msg=name)
    torch.testing.assert_close(before, images.grad / 2, rtol=1e-10, atol=1e-12)


def test_nothing_is_changed_without_gradients_or_after_an_error() -> None:
    loop, images = Loop(), torch.zeros(3, 1, 6, 6)
    with torch.no_grad(), gathered_gradients(loop, like=images):
        assert not any("forward" in vars(layer) for layer in loop.modules())
    with contextlib.suppress(ZeroDivisionError), gathered_gradients(loop, like=images):
        raise ZeroDivisionError
    assert not any("forward" in vars(layer) for layer in loop.modules())

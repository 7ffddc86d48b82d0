"""Stacks of layers in parts against the layers one by one, by number."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import enlarged, halved, same
from apex_lab.nn.celu_stack import Block, Layer, fast_on, run_layers, run_stack, side_by_side, stack_of

DOUBLE = {"rtol": 1e-10, "atol": 1e-11}


def drawn(*layers: nn.Module, dtype: torch.dtype = torch.float64) -> nn.Sequential:
    """Layers whose norms do something, too."""
    torch.manual_seed(0)
    network = nn.Sequential(*layers).to(dtype)
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(0.2 * torch.randn_like(weight))
    return network


def both(network: nn.Sequential, images: Tensor, keep: bool, each: int) -> list[list[Tensor]]:
    """Output and gradients, by layers and by the stack."""
    found = []
    for fast in (False, True):
        x = images.clone().requires_grad_()
        output = run_stack(stack_of(network), x, each, keep) if fast else network(x)
        given = torch.randn(output.shape, generator=torch.Generator().manual_seed(1), dtype=output.dtype)
        found.append([output, *torch.autograd.grad(output, [x, *network.parameters()], given)])
    return found


STACKS = {
    "encoder": ((5, 3, 16, 16), [*halved(3, 16), *same(16, 32), *halved(32, 32), nn.Conv2d(32, 6, 4)]),
    "decoder": (
        (5, 7, 1, 1),
        [*same(7, 32, kernel=1), *enlarged(32, 16, 4), *enlarged(16, 8, 2), nn.Conv2d(8, 3, 3, padding=1)],
    ),
    "odd sides": ((3, 4, 6, 10), [*same(4, 8), *enlarged(8, 16, 2), *same(16, 8), nn.Conv2d(8, 1, 1)]),
}


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("each", [2, 5])
@pytest.mark.parametrize("name", STACKS)
def test_the_layers_one_by_one(name: str, each: int, keep: bool) -> None:
    shape, layers = STACKS[name]
    one_by_one, stacked = both(drawn(*layers), torch.randn(shape, dtype=torch.float64), keep, each)
    for a, b in zip(stacked, one_by_one, strict=True):
        torch.testing.assert_close(a, b, **DOUBLE)
    assert stacked[0].is_contiguous()


def test_single_precision() -> None:
    shape, layers = STACKS["decoder"]
    network = drawn(*layers, dtype=torch.float32)
    one_by_one, stacked = both(network, torch.randn(shape), True, 2)
    for a, b in zip(stacked, one_by_one, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.detach().abs().max()))


def test_without_gradients_and_for_an_input_without() -> None:
    network = drawn(*same(3, 8), nn.Conv2d(8, 2, 1))
    images = torch.randn(4, 3, 6, 6, dtype=torch.float64)
    want = network(images)
    with torch.no_grad():
        torch.testing.assert_close(run_layers(network, images), want, **DOUBLE)
    got = run_layers(network, images)
    parameters = list(network.parameters())
    for a, b in zip(
        torch.autograd.grad(got.sum(), parameters), torch.autograd.grad(want.sum(), parameters), strict=True
    ):
        torch.testing.assert_close(a, b, **DOUBLE)


def test_two_stacks_side_by_side() -> None:
    a, b = drawn(*same(4, 8), nn.Conv2d(8, 3, 3, padding=1)), drawn(*same(4, 8), nn.Conv2d(8, 1, 3, padding=1))
    images = torch.randn(3, 4, 6, 6, dtype=torch.float64)
    together = run_stack(side_by_side(stack_of(a), stack_of(b)), images, 2)
    apart = torch.cat([a(images), b(images)], dim=1)
    torch.testing.assert_close(together, apart, **DOUBLE)
    parameters, given = [*a.parameters(), *b.parameters()], torch.randn_like(apart)
    pairs = zip(*(torch.autograd.grad(x, parameters, given) for x in (together, apart)), strict=True)
    for x, y in pairs:
        torch.testing.assert_close(x, y, **DOUBLE)


def test_a_linear_layer_at_the_end() -> None:
    layers, head = drawn(*same(3, 8)), nn.Linear(8, 5).double()
    images = torch.randn(4, 3, 1, 1, dtype=torch.float64)
    stack = [*stack_of(layers), Block(Layer(1, 0), head.weight[..., None, None], head.bias)]
    torch.testing.assert_close(run_stack(stack, images, 4).flatten(1), head(layers(images).flatten(1)), **DOUBLE)


def test_other_layers_are_refused() -> None:
    with pytest.raises(TypeError, match="ReLU"):
        stack_of([nn.Conv2d(3, 4, 1), nn.ReLU()])


def test_half_precision_goes_by_the_layers() -> None:
    network, images = drawn(*same(3, 8), nn.Conv2d(8, 2, 1), dtype=torch.float32), torch.randn(2, 3, 4, 4)
    with torch.autocast("cpu", torch.bfloat16):
        assert not fast_on(images)
        assert run_layers(network, images).dtype == torch.bfloat16

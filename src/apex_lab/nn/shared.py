"""Gradients of weights that a loop over time uses in every frame, made once for all frames, on a CPU.

Autograd makes the gradient of a weight for each use and adds them up. Of a dozen objects in a frame, these are many
small products and passes over whole weights, where one product over the objects of all frames does as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.nn.slots import may_look

Gradients = Callable[[Tensor, Tensor], tuple[Tensor, Tensor | None]]
"""Inputs and gradients of outputs of all uses -> gradients of weight and bias."""


@contextlib.contextmanager
def gathered_gradients(*modules: nn.Module, like: Tensor) -> Iterator[None]:
    """Inside, linear layers, convolutions and GRU cells of the modules get their weights' gradients once for all calls.

    Results and gradients are the same up to rounding. It does nothing but on a CPU in one precision, and not without
    gradients. Gradients of these gradients do not exist.

    Args:
        modules: with all that they hold; other kinds of layers are left as they are.
        like: a tensor of the device that they work on.
    """
    on = may_look(like) and torch.is_grad_enabled()
    layers = [x for module in modules for x in module.modules() if type(x) in _GATHERED] if on else []
    for layer in layers:
        vars(layer)["forward"] = _GATHERED[type(layer)](layer)
    try:
        yield
    finally:
        for layer in layers:
            del vars(layer)["forward"]


class _Uses:
    """Inputs and gradients of outputs, use by use: a second pass over a graph that is kept replaces those of the first.

    It holds no part of the graph: the graph holds it, and Python could not collect the circle.
    """

    def __init__(self, gradients: Gradients) -> None:
        self.gradients, self.count = gradients, 0
        self.noted: dict[int, tuple[Tensor, Tensor]] = {}

    def next(self) -> int:
        self.count += 1
        return self.count

    def note(self, use: int, inputs: Tensor, gradient: Tensor) -> None:
        self.noted[use] = inputs.detach(), gradient


class _Gathered(torch.autograd.Function):
    """A weight for its uses; they all give back their gradients before its own turn comes."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor, bias: Tensor | None, uses: _Uses) -> Tensor:  # type: ignore[override]
        ctx.uses = uses
        ctx.set_materialize_grads(False)
        return weight.view_as(weight)

    @staticmethod
    def backward(ctx: Any, _: None) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[override]
        pairs = list(ctx.uses.noted.values())
        if not pairs:
            return None, None, None
        ctx.uses.noted.clear()
        inputs, gradients = (torch.cat(values) if len(pairs) > 1 else values[0] for values in zip(*pairs, strict=True))
        return *ctx.uses.gradients(inputs, gradients), None


class _Linear(torch.autograd.Function):
    """A linear layer that notes what its weights' gradients need."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, uses: _Uses) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(x, weight)
        ctx.uses, ctx.use = uses, uses.next()
        return F.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, weight = ctx.saved_tensors
        rows = (x, grad) if x.dim() == 2 else (x.flatten(0, -2), grad.flatten(0, -2))
        ctx.uses.note(ctx.use, *rows)
        return grad @ weight if ctx.needs_input_grad[0] else None, None, None, None


class _Convolution(torch.autograd.Function):
    """A convolution that notes what its weights' gradients need."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, layer: nn.Conv2d, uses: _Uses) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(x, weight)
        ctx.layer, ctx.uses, ctx.use = layer, uses, uses.next()
        return layer._conv_forward(x, weight, layer.bias)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, weight = ctx.saved_tensors
        ctx.uses.note(ctx.use, x, grad)
        if not ctx.needs_input_grad[0]:
            return None, None, None, None
        return _through_convolution(ctx.layer, grad, x, weight, (True, False, False))[0], None, None, None


def _through_convolution(
    layer: nn.Conv2d, grad: Tensor, x: Tensor, weight: Tensor, wanted: tuple[bool, bool, bool]
) -> Any:
    """Gradients of a convolution's input, weight and bias, those that are wanted."""
    how = (layer.stride, layer.padding, layer.dilation, False, [0, 0], layer.groups)
    return torch.ops.aten.convolution_backward(grad, x, weight, [layer.out_channels], *how, wanted)


class _GruCell(torch.autograd.Function):
    """A GRU cell (`nn.GRUCell`) in few passes, which notes what its weights' gradients need.

    r, z = sigmoid of input's and state's parts; n = tanh(i_n + r h_n); the new state is n + z (h - n).
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        x: Tensor,
        h: Tensor,
        w_x: Tensor,
        w_h: Tensor,
        biases: tuple[Tensor | None, Tensor | None],
        uses: tuple[_Uses, _Uses],
    ) -> Tensor:
        size = h.shape[1]
        of_x, of_h = F.linear(x, w_x, biases[0]), F.linear(h, w_h, biases[1])
        gates = of_h[:, : 2 * size].add_(of_x[:, : 2 * size]).sigmoid_()
        r, z = gates.chunk(2, dim=1)
        h_n = of_h[:, 2 * size :]
        n = torch.addcmul(of_x[:, 2 * size :], r, h_n).tanh_()
        ctx.save_for_backward(x, h, w_x, w_h, of_h, n)
        ctx.uses = [(each, each.next()) for each in uses]
        return torch.lerp(n, h, z)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, h, w_x, w_h, of_h, n = ctx.saved_tensors
        size = h.shape[1]
        r, z, h_n = of_h.chunk(3, dim=1)
        kept = grad * z
        to_n = torch.ops.aten.tanh_backward(grad - kept, n)
        to_gates = torch.cat([to_n * h_n, grad * (h - n)], dim=1)
        to_gates = torch.ops.aten.sigmoid_backward(to_gates, of_h[:, : 2 * size])
        to_x, to_h = torch.cat([to_gates, to_n], dim=1), torch.cat([to_gates, to_n * r], dim=1)
        for (uses, use), inputs, gradient in zip(ctx.uses, (x, h), (to_x, to_h), strict=True):
            uses.note(use, inputs, gradient)
        return (
            to_x @ w_x if ctx.needs_input_grad[0] else None,
            torch.addmm(kept, to_h, w_h) if ctx.needs_input_grad[1] else None,
            *[None] * 4,
        )


def _of_rows(x: Tensor, grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of a linear map's weight and bias, of all rows."""
    return grad.T @ x, grad.sum(0)


def _handle(weight: Tensor, bias: Tensor | None, gradients: Gradients) -> tuple[Tensor, Tensor | None, _Uses]:
    """A weight for its uses, its bias without gradient, and where to note uses."""
    uses = _Uses(gradients if bias is not None else lambda x, grad: (gradients(x, grad)[0], None))
    return _Gathered.apply(weight, bias, uses), None if bias is None else bias.detach(), uses


def _linear(layer: nn.Linear) -> Callable[[Tensor], Tensor]:
    of_layer = _handle(layer.weight, layer.bias, _of_rows)
    return lambda x: _Linear.apply(x, *of_layer)


def _convolution(layer: nn.Conv2d) -> Callable[[Tensor], Tensor]:
    wanted = (False, True, layer.bias is not None)

    def gradients(x: Tensor, grad: Tensor) -> tuple[Tensor, Tensor | None]:
        _, of_weight, of_bias = _through_convolution(layer, grad, x, layer.weight.detach(), wanted)
        return of_weight, of_bias

    weight, _, uses = _handle(layer.weight, layer.bias, gradients)
    return lambda x: _Convolution.apply(x, weight, layer, uses)


def _gru_cell(layer: nn.GRUCell) -> Callable[[Tensor, Tensor], Tensor]:
    w_x, b_x, uses_x = _handle(layer.weight_ih, layer.bias_ih, _of_rows)
    w_h, b_h, uses_h = _handle(layer.weight_hh, layer.bias_hh, _of_rows)
    return lambda x, h: _GruCell.apply(x, h, w_x, w_h, (b_x, b_h), (uses_x, uses_h))


_GATHERED: dict[type[nn.Module], Callable[[Any], Callable[..., Tensor]]] = {
    nn.Linear: _linear,
    nn.Conv2d: _convolution,
    nn.GRUCell: _gru_cell,
}

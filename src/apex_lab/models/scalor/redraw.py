"""Glimpses that are drawn without gradients get theirs by being drawn again in the backward pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Draw = Callable[[Tensor], Tensor]


class _Redrawn(torch.autograd.Function):
    """What has been drawn, as it is; the backward pass draws part by part again, and leaves each part at once.

    A part's activations are thus in the cache when its gradient needs them, and never more than a part's are held.
    """

    @staticmethod
    def forward(ctx: Any, draw: Draw, each: int, drawn: Tensor, what: Tensor, *weights: Tensor) -> Tensor:
        ctx.draw, ctx.each = draw, each
        ctx.cast = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")
        ctx.save_for_backward(what, *weights)
        return drawn

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_drawn: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        what, *weights = ctx.saved_tensors
        enabled, dtype = ctx.cast
        on_what: list[Tensor] = []
        on_weights: list[Tensor] = []
        for part, on_part in zip(what.split(ctx.each), on_drawn.split(ctx.each), strict=True):
            with torch.enable_grad(), torch.autocast("cpu", dtype=dtype, enabled=enabled):
                code = part.detach().requires_grad_()
                drawn = ctx.draw(code)
            first, *others = torch.autograd.grad(drawn, [code, *weights], on_part)
            on_what.append(first)
            on_weights = [a + b for a, b in zip(on_weights, others, strict=True)] if on_weights else others
        return None, None, None, torch.cat(on_what), *on_weights


def redrawn(
    draw: Draw, network: nn.Module, each: int, drawn: Float[Tensor, "N C g g"], what: Float[Tensor, "N Z"]
) -> Float[Tensor, "N C g g"]:
    """`drawn`, with the gradients of `draw(what)`.

    Costs one more forward pass of the network, as keeping no activations of `draw(what)` would; but the first pass has
    been made already.

    Args:
        draw: draws each row for itself, without random numbers.
        network: all of whose parameters it uses.
        each: rows of a part.
        drawn: draw(what), without gradient.
        what: codes.
    """
    return _Redrawn.apply(draw, each, drawn, what, *(p for p in network.parameters() if p.requires_grad))

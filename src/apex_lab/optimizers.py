"""Muon, with Adam for what is no matrix: for runs of some thousand steps, such as `scale=cpu`.

PyTorch's Muon takes 2-dimensional weights alone and computes in bfloat16, which CPUs without it emulate; this one takes
convolutions too, computes in the weights' own precision, and is one optimiser with one state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.optim import Optimizer

Positive = Annotated[float, Field(gt=0)]
Decay = Annotated[float, Field(ge=0, lt=1)]

QUINTIC = (3.4445, -4.7750, 2.0315)
"""Coefficients of Jordan et al. 2024 (Muon): they bring singular values near 1 in few iterations, not exactly to 1."""

NOTHING = 1e-7
"""Norm below which a momentum counts for less and less, so that weights without gradients come to rest."""


def orthogonalised(matrix: Float[Tensor, "rows columns"], iterations: int = 5) -> Float[Tensor, "rows columns"]:
    """The matrix with its singular values brought near 1 and its singular vectors kept.

    Five iterations bring singular values of 0.0015 to 1 times the Frobenius norm to between 0.68 and 1.2; smaller ones
    are multiplied by at most 485. Newton-Schulz iteration x <- (a + b x x^T + c (x x^T)^2) x, carried out on the small
    square x x^T and applied to the matrix once. A matrix whose norm is far below `NOTHING` goes to zero.
    """
    a, b, c = QUINTIC
    wide = matrix.shape[0] <= matrix.shape[1]
    x = matrix if wide else matrix.T
    x = x / x.norm().clamp_min(NOTHING)
    gram, applied = x @ x.T, torch.eye(len(x), dtype=x.dtype, device=x.device)
    for _ in range(iterations):
        step = torch.addmm(gram, gram, gram, beta=b, alpha=c)
        step.diagonal().add_(a)
        applied, gram = step @ applied, step @ gram @ step
    x = applied @ x
    return x if wide else x.T


def is_matrix(weight: Tensor) -> bool:
    """Whether Muon takes a weight: a linear map or a convolution with more than one input and one output."""
    return weight.dim() in (2, 4) and min(weight.shape[0], weight[0].numel()) > 1


class Muon(Optimizer):
    """Momentum, orthogonalised per weight matrix (Jordan et al. 2024); Adam for biases, gains and bias images.

    A matrix of `rows` x `columns` (a convolution: outputs x inputs times kernel) moves by its orthogonalised Nesterov
    momentum times lr sqrt(max(1, rows / columns)), so directions that its gradients agree on are learned at once, weak
    ones too.

    Args:
        params: the weights.
        lr: of the matrices.
        momentum: of the matrices.
        adam_lr: of everything else.
        beta1, beta2: Adam's.
        eps: Adam's.
        iterations: of the orthogonalisation; above 6, float32 does not carry it for matrices of low rank.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: Positive = 0.01,
        momentum: Decay = 0.95,
        adam_lr: Positive = 1e-3,
        beta1: Decay = 0.9,
        beta2: Decay = 0.999,
        eps: Positive = 1e-8,
        iterations: Annotated[int, Field(ge=1, le=6)] = 5,
    ) -> None:
        weights = list(params)
        matrices, others = [w for w in weights if is_matrix(w)], [w for w in weights if not is_matrix(w)]
        groups: list[dict[str, Any]] = []
        if matrices:
            groups.append({"params": matrices, "matrices": True, "lr": lr})
        if others:
            groups.append({"params": others, "matrices": False, "lr": adam_lr})
        common = {"momentum": momentum, "beta1": beta1, "beta2": beta2, "eps": eps, "iterations": iterations}
        super().__init__(groups, common)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One update; `closure`, where there is one, computes loss and gradients anew."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            update = self._muon if group["matrices"] else self._adam
            for weight in group["params"]:
                if weight.grad is not None:
                    update(weight, weight.grad, self.state[weight], group)
        return loss

    @staticmethod
    def _muon(weight: Tensor, grad: Tensor, state: dict[str, Any], group: dict[str, Any]) -> None:
        if not state:
            state["momentum"] = torch.zeros_like(weight)
        momentum = state["momentum"].lerp_(grad, 1 - group["momentum"])
        ahead = grad.lerp(momentum, group["momentum"]).flatten(1)
        rows, columns = ahead.shape
        stretch = max(1.0, rows / columns) ** 0.5
        weight.sub_(orthogonalised(ahead, group["iterations"]).view_as(weight), alpha=group["lr"] * stretch)

    @staticmethod
    def _adam(weight: Tensor, grad: Tensor, state: dict[str, Any], group: dict[str, Any]) -> None:
        if not state:
            # not "step": PyTorch leaves a tensor of that name on the CPU when it loads a state
            state["updates"] = torch.zeros((), device=weight.device, dtype=weight.dtype)
            state["mean"], state["square"] = torch.zeros_like(weight), torch.zeros_like(weight)
        step, beta1, beta2 = state["updates"].add_(1), group["beta1"], group["beta2"]
        mean = state["mean"].lerp_(grad, 1 - beta1)
        square = state["square"].lerp_(grad.square(), 1 - beta2)
        spread = (square / (1 - beta2**step)).sqrt_().add_(group["eps"])
        weight.sub_(group["lr"] * mean / ((1 - beta1**step) * spread))

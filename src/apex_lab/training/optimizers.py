"""Muon, with Adam for all but matrices: for runs of some thousand steps, such as `scale=cpu`.

PyTorch's Muon takes 2-dimensional weights alone and computes in bfloat16, which CPUs without it emulate; this one takes
convolutions too, computes in the weights' own precision, and is one optimiser with one state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.optim import Optimizer

from apex_lab.nn.precision import full_products

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
    return all_orthogonalised([matrix], iterations)[0]


def all_orthogonalised(matrices: Sequence[Float[Tensor, "_ _"]], iterations: int = 5) -> list[Tensor]:
    """`orthogonalised` of each matrix; those whose smaller side is equally long are iterated together."""
    wide = [m if m.shape[0] <= m.shape[1] else m.T for m in matrices]
    norms = [norm.clamp_min_(NOTHING) for norm in torch._foreach_norm(wide)]
    wide = list(torch._foreach_div(wide, norms))
    applied: list[Tensor] = list(wide)
    kinds = [(len(x), x.dtype, x.device) for x in wide]
    for kind in dict.fromkeys(kinds):
        chosen = [i for i, other in enumerate(kinds) if other == kind]
        iterated = _newton_schulz(torch.stack([wide[i] @ wide[i].T for i in chosen]), iterations)
        for i, factor in zip(chosen, iterated.unbind(), strict=True):
            applied[i] = factor @ wide[i]
    return [x if m.shape[0] <= m.shape[1] else x.T for x, m in zip(applied, matrices, strict=True)]


def _newton_schulz(gram: Float[Tensor, "N n n"], iterations: int) -> Float[Tensor, "N n n"]:
    """What matrices with these x x^T are to be multiplied by from the left."""
    a, b, c = QUINTIC
    applied: Tensor | None = None
    for left in reversed(range(iterations)):
        step = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        step.diagonal(dim1=-2, dim2=-1).add_(a)
        applied = step if applied is None else torch.bmm(step, applied)
        if left:
            gram = torch.bmm(torch.bmm(step, gram), step)
    assert applied is not None
    return applied


def is_matrix(weight: Tensor) -> bool:
    """Whether Muon takes a weight: a linear map or a convolution with more than one input and one output."""
    return weight.dim() in (2, 4) and min(weight.shape[0], weight[0].numel()) > 1


def _is_matrix(weight: nn.Parameter | tuple[str, nn.Parameter]) -> bool:
    return is_matrix(weight[1] if isinstance(weight, tuple) else weight)


class Muon(Optimizer):
    """Momentum, orthogonalised per weight matrix (Jordan et al. 2024); Adam for biases, gains and bias images.

    A matrix of `rows` x `columns` (a convolution: outputs x inputs times kernel) moves by its orthogonalised Nesterov
    momentum times lr sqrt(max(1, rows / columns)), so directions that its gradients agree on are learned at once, weak
    ones too.

    Args:
        params: the weights, with or without their names.
        lr: of the matrices.
        momentum: of the matrices.
        adam_lr: of everything else.
        beta1, beta2: Adam's.
        eps: Adam's.
        iterations: of the orthogonalisation; above 6, float32 does not carry it for matrices of low rank.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter] | Iterable[tuple[str, nn.Parameter]],
        lr: Positive = 0.01,
        momentum: Decay = 0.95,
        adam_lr: Positive = 1e-3,
        beta1: Decay = 0.9,
        beta2: Decay = 0.999,
        eps: Positive = 1e-8,
        iterations: Annotated[int, Field(ge=1, le=6)] = 5,
    ) -> None:
        weights: list[Any] = list(params)
        matrices, others = [w for w in weights if _is_matrix(w)], [w for w in weights if not _is_matrix(w)]
        groups: list[dict[str, Any]] = []
        if matrices:
            groups.append({"params": matrices, "matrices": True, "lr": lr})
        if others:
            groups.append({"params": others, "matrices": False, "lr": adam_lr})
        common = {"momentum": momentum, "beta1": beta1, "beta2": beta2, "eps": eps, "iterations": iterations}
        super().__init__(groups, common)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One update; `closure`, where there is one, computes loss and gradients again."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            weights = [weight for weight in group["params"] if weight.grad is not None]
            if weights:
                (self._muon if group["matrices"] else self._adam)(weights, group)
        return loss

    def _muon(self, weights: Sequence[Tensor], group: dict[str, Any]) -> None:
        for weight in weights:
            if not self.state[weight]:
                self.state[weight]["momentum"] = torch.zeros_like(weight)
        grads = [cast(Tensor, weight.grad) for weight in weights]
        momenta = [self.state[weight]["momentum"] for weight in weights]
        torch._foreach_lerp_(momenta, grads, 1 - group["momentum"])
        ahead = [x.flatten(1) for x in torch._foreach_lerp(grads, momenta, group["momentum"])]
        # neither bfloat16 nor TF32 carries the iteration: of nearly one direction they make another matrix
        device = weights[0].device
        with torch.autocast(device.type, enabled=False), full_products(device):
            changes = all_orthogonalised(ahead, group["iterations"])
        for weight, change in zip(weights, changes, strict=True):
            rate = group["lr"] * max(1.0, change.shape[0] / change.shape[1]) ** 0.5
            change = change.reshape(weight.shape)
            if isinstance(rate, Tensor):  # as a factor: an `alpha` would be read by the host
                weight.sub_(change * rate)
            else:
                weight.sub_(change, alpha=rate)

    def _adam(self, weights: Sequence[Tensor], group: dict[str, Any]) -> None:
        for weight in weights:
            if not self.state[weight]:
                # not "step": PyTorch leaves a tensor of that name on the CPU when it loads a state
                updates = torch.zeros((), device=weight.device, dtype=weight.dtype)
                mean, square = torch.zeros_like(weight), torch.zeros_like(weight)
                self.state[weight].update(updates=updates, mean=mean, square=square)
        grads = [cast(Tensor, weight.grad) for weight in weights]
        counts, means, squares = ([self.state[w][key] for w in weights] for key in ("updates", "mean", "square"))
        beta1, beta2 = group["beta1"], group["beta2"]
        torch._foreach_add_(counts, 1)
        made = torch.stack(counts)
        torch._foreach_lerp_(means, grads, 1 - beta1)
        torch._foreach_lerp_(squares, torch._foreach_mul(grads, grads), 1 - beta2)
        spread = torch._foreach_div(squares, (1 - beta2**made).unbind())
        torch._foreach_sqrt_(spread)
        torch._foreach_add_(spread, group["eps"])
        torch._foreach_mul_(spread, (1 - beta1**made).unbind())
        changes = torch._foreach_mul(means, group["lr"])
        torch._foreach_div_(changes, spread)
        torch._foreach_sub_(list(weights), list(changes))

"""The interaction network that carries slots to the next frame, without actions (op3.md section 5)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.op3.posterior import RawGaussian
from apex_lab.nn.precision import full

EFFECT = 32


class Predicted(NamedTuple):
    """The next frame's slots: deterministic state (B, K, R) and the Gaussian of the stochastic one (B, K, S)."""

    deterministic: Tensor
    stochastic: RawGaussian


def mlp(inputs: int, hidden: int, outputs: int, last: nn.Module | None = None) -> nn.Sequential:
    """Linear, ELU, linear, and an activation of the output, if any."""
    first, second = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)
    # by the output's width: the published code takes that axis for the fan-in
    nn.init.uniform_(first.weight, -1 / math.sqrt(hidden), 1 / math.sqrt(hidden))
    nn.init.constant_(first.bias, 0.1)
    for parameter in second.parameters():
        nn.init.uniform_(parameter, -3e-3, 3e-3)
    return nn.Sequential(first, nn.ELU(), second, *([] if last is None else [last]))


class Dynamics(nn.Module):
    """Every slot moves by itself and is affected by every other one, by weights that all slots share.

    Args:
        deterministic: R, length of the deterministic state.
        stochastic: S, length of the stochastic state.
    """

    def __init__(self, deterministic: int, stochastic: int) -> None:
        super().__init__()
        full = deterministic + stochastic
        self.inertia = mlp(full, full, full, nn.ELU())
        self.pair = mlp(2 * full, 2 * full, full, nn.ELU())
        self.effect = mlp(full, full, EFFECT, nn.ELU())
        self.attention = mlp(full, full, 1, nn.Sigmoid())
        self.merge = mlp(full + EFFECT, full, full, nn.ELU())
        self.to_deterministic = mlp(full, full, deterministic)
        self.to_mean = mlp(full, full, stochastic)
        self.to_raw = mlp(full, full, stochastic)

    def forward(self, slots: Float[Tensor, "B K Z"]) -> Predicted:
        """Full slot states [d; z] of one frame -> the next frame's."""
        k = slots.shape[1]
        each = self.inertia(slots)
        receiver, other = each[:, :, None].expand(-1, -1, k, -1), each[:, None].expand(-1, k, -1, -1)
        pairs = self.pair(torch.cat([receiver, other], dim=-1))
        others = 1 - torch.eye(k, dtype=pairs.dtype, device=pairs.device)
        # a gated sum: neither softmax nor mean
        effects = (self.attention(pairs) * self.effect(pairs) * others[..., None]).sum(2)
        merged = self.merge(torch.cat([each, effects], dim=-1))
        return Predicted(
            full(self.to_deterministic(merged)),
            RawGaussian(full(self.to_mean(merged)), full(self.to_raw(merged))),
        )

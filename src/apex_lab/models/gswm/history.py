"""What happened to an object: interaction with others, its surroundings, a recurrent state (gswm.md section 7).

The posterior's and the prior's chain have the same form and weights of their own; they run side by side as the first
dimension ("2") of all tensors here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.gswm.boxes import enlarged
from apex_lab.models.gswm.latents import SHIFT
from apex_lab.models.gswm.networks import Encoder
from apex_lab.nn.precision import full
from apex_lab.nn.slots import gather_slots
from apex_lab.nn.spatial_transformer import crop, window_of

Environment = Literal["attention", "whole", "none"]

CHAINS = 2
WEIGHT_GUARD = 1e-4


class Memory(NamedTuple):
    """Recurrent states (2, B, N, hidden) of N objects: hidden and cell state of both chains."""

    hidden: Tensor
    cell: Tensor


class ChainLinear(nn.Module):
    """A linear layer per chain, (2, ..., inputs) -> (2, ..., outputs); it starts as `nn.Linear` does.

    Args:
        inputs, outputs: lengths of the vectors.
        bound: weights start in [-bound, bound]; None: 1 / sqrt(inputs).
    """

    def __init__(self, inputs: int, outputs: int, bound: float | None = None) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        self.weight = nn.Parameter(torch.empty(CHAINS, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(CHAINS, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Float[Tensor, "two *batch inputs"]) -> Float[Tensor, "two *batch outputs"]:
        return chain_product(x, self.weight, self.bias)


def chain_product(
    x: Float[Tensor, "n *batch inputs"], weight: Float[Tensor, "n inputs outputs"], bias: Float[Tensor, "n 1 outputs"]
) -> Float[Tensor, "n *batch outputs"]:
    """x W + b with weights of its own for each entry of the first dimension."""
    return torch.baddbmm(bias, x.flatten(1, -2), weight).unflatten(1, x.shape[1:-1])


class ChainMLP(nn.Module):
    """A perceptron of three layers per chain, with CELU between them."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = ChainLinear(inputs, hidden), ChainLinear(hidden, hidden)
        self.last = ChainLinear(hidden, outputs)

    def forward(self, x: Float[Tensor, "two *batch inputs"]) -> Float[Tensor, "two *batch outputs"]:
        return self.last(F.celu(self.second(F.celu(self.first(x)))))


class Fused(NamedTuple):
    """Weights of the pair and logit networks, chain by chain, arranged once per pass.

    row (4, phi, hidden), row_bias, column (4, phi, hidden): the first layer, split; second, second_bias: the next one;
    n = 4: the pair network of both chains, then the logit network of both.
    """

    row: Tensor
    row_bias: Tensor
    column: Tensor
    second: Tensor
    second_bias: Tensor


class Interaction(nn.Module):
    """How objects of a frame act on each other, by learned attention over pairs.

    The published networks read every pair's concatenated features. Their first layer is linear, so it splits into a
    part of the one object and a part of the other; their last layer is linear too, so it may follow the weighted sum
    over partners. Between them, one layer per pair is left of three.

    Args:
        objects: length of Z.
        hidden: of the recurrent states and the networks.
    """

    def __init__(self, objects: int, hidden: int) -> None:
        super().__init__()
        phi = objects + hidden
        self.phi = phi
        self.self_net = ChainMLP(phi, hidden, hidden)
        self.pair_net = ChainMLP(2 * phi, hidden, hidden)
        self.logit_net = ChainMLP(2 * phi, hidden, 1)

    def fused(self) -> Fused:
        """Arranges the weights for `forward`.

        A partner's centre is seen relative to the object's, t_k - t_j, in place of t_j: its weights are the object's
        too, and negative for the partner.
        """
        nets = (self.pair_net, self.logit_net)
        first = torch.cat([net.first.weight for net in nets])
        row, column = first.split(self.phi, dim=1)
        before, shift, behind = column.split([SHIFT.start, 2, self.phi - SHIFT.stop], dim=1)
        zeros = torch.zeros_like
        return Fused(
            row + torch.cat([zeros(before), shift, zeros(behind)], dim=1),
            torch.cat([net.first.bias for net in nets]),
            torch.cat([before, -shift, behind], dim=1),
            torch.cat([net.second.weight for net in nets]),
            torch.cat([net.second.bias for net in nets]),
        )

    def forward(
        self,
        rows: Float[Tensor, "2 B M phi"],
        columns: Float[Tensor, "2 B N phi"],
        presence: Float[Tensor, "B N"],
        together: Bool[Tensor, "B M N"] | None,
        itself: Bool[Tensor, "B M N"],
        fused: Fused,
    ) -> Float[Tensor, "2 B M hidden"]:
        """Features of M objects and of N possible partners -> what acts on each of the M.

        Args:
            rows, columns: Z and recurrent state of the objects and of their partners.
            presence: z_pres of the partners.
            together: pairs that may act on each other; None: all.
            itself: pairs of an object with itself.
            fused: `self.fused()`.
        """
        of_row = chain_product(torch.cat([rows, rows]), fused.row, fused.row_bias)
        of_column = torch.bmm(torch.cat([columns, columns]).flatten(1, 2), fused.column)
        of_column = of_column.unflatten(1, columns.shape[1:3])
        pairs = F.celu(of_row[:, :, :, None] + of_column[:, :, None], inplace=True)
        read = F.celu(torch.baddbmm(fused.second_bias, pairs.flatten(1, -2), fused.second), inplace=True)
        effects, scores = read.unflatten(1, pairs.shape[1:-1]).split(CHAINS)
        logits = full(self.logit_net.last(scores).squeeze(-1))
        if together is not None:
            logits = logits.masked_fill(~together, -torch.inf)
        weights = logits.softmax(-1) * presence[:, None]
        weights = weights.masked_fill(itself, 0.0)
        weights = weights / (weights.sum(-1, keepdim=True) + WEIGHT_GUARD)
        summed = (weights[..., None, :].to(effects.dtype) @ effects).squeeze(-2)
        last = self.pair_net.last
        bias = last.bias[:, None] * weights.sum(-1, keepdim=True)
        acting = torch.bmm(summed.flatten(1, 2), last.weight).unflatten(1, summed.shape[1:3]) + bias
        return self.self_net(rows) + acting


class History(nn.Module):
    """Z of a frame and the recurrent states before it -> the states after it.

    Args:
        objects: length of Z.
        hidden: of the recurrent states and the networks.
        environment: what of the background an object sees: a crop around it, the whole image, or nothing.
        margin: how much larger than the object's box the crop is, as a share of the image side.
        size: side of the crops in pixels; with `whole`, of the image.
        widths: channels of the encoder of crops.
    """

    def __init__(
        self,
        objects: int,
        hidden: int,
        environment: Environment,
        margin: float,
        size: int,
        widths: Sequence[int],
    ) -> None:
        super().__init__()
        self.hidden, self.margin, self.size = hidden, margin, size
        self.environment = environment
        if environment != "none":
            self.encoder = Encoder(
                size, widths, hidden, name="glimpse_size" if environment == "attention" else "image_size"
            )
        self.interaction = Interaction(objects, hidden)
        self.input = ChainLinear(objects + 2 * hidden, hidden)
        bound = 1 / math.sqrt(hidden)
        self.from_input = ChainLinear(hidden, 4 * hidden, bound)
        self.from_hidden = ChainLinear(hidden, 4 * hidden, bound)
        self.start = nn.Parameter(torch.randn(2, CHAINS, hidden))

    def begin(self, batch: int, count: int) -> Memory:
        """The learned states that all new objects start from."""
        return Memory(*self.start[:, :, None, None].expand(-1, -1, batch, count, -1))

    def scenery(self, backdrops: Float[Tensor, "B T 3 H W"]) -> Tensor:
        """What `surroundings` reads of the background's images, before the loop over time: (B, T, ...).

        Objects that see the whole image need its code alone, which depends on no frame before; else, the images.
        """
        if self.environment != "whole":
            return backdrops
        return self.encoder(backdrops.flatten(0, 1)).unflatten(0, backdrops.shape[:2])

    def surroundings(self, where: Float[Tensor, "B M 4"], scenery: Tensor) -> Float[Tensor, "B M hidden"]:
        """Codes of the background around boxes; both chains see the same. `scenery` (B, ...): that of the frame."""
        if self.environment == "none":
            return where.new_zeros(*where.shape[:2], self.hidden)
        if self.environment == "whole":
            return scenery[:, None].expand(-1, where.shape[1], -1)
        crops = crop(scenery, window_of(enlarged(where, self.margin)), self.size)
        return self.encoder(crops.flatten(0, 1)).unflatten(0, crops.shape[:2])

    def forward(
        self,
        z: Float[Tensor, "B N Z"],
        memory: Memory,
        source: Int[Tensor, "B M"],
        cells: int,
        scenery: Tensor,
        fused: Fused,
    ) -> tuple[Float[Tensor, "B M Z"], Memory]:
        """Takes the M objects at `source` out of N and advances their states.

        Discovered objects, the first `cells` of the N, interact with each other, and so do the tracked ones behind
        them. All are partners, but the states of those that are not taken are needed no more. `scenery` is that of the
        frame (see the method).
        """
        taken = gather_slots(z, source)
        hidden, cell = (gather_slots(state, source, dim=2) for state in memory)
        index = torch.arange(z.shape[1], device=z.device)
        together = None
        if cells < z.shape[1]:
            together = (source >= cells)[..., None] == (index >= cells)
        rows = torch.cat([taken.expand(CHAINS, *taken.shape), hidden], dim=-1)
        columns = torch.cat([z.expand(CHAINS, *z.shape), memory.hidden], dim=-1)
        acting = self.interaction(rows, columns, z[..., 0], together, source[..., None] == index, fused)
        around = self.surroundings(taken[..., 2:6], scenery)
        seen = torch.cat([rows[..., : z.shape[-1]], acting, around.expand_as(acting).to(acting.dtype)], dim=-1)
        return taken, self._advance(self.input(seen), Memory(hidden, cell))

    def _advance(self, x: Tensor, memory: Memory) -> Memory:
        """An LSTM cell per chain."""
        gates = self.from_input(x) + self.from_hidden(memory.hidden)
        into, forget, new, out = full(gates).chunk(4, dim=-1)
        cell = torch.sigmoid(forget) * memory.cell + torch.sigmoid(into) * torch.tanh(new)
        return Memory(torch.sigmoid(out) * torch.tanh(cell), cell)

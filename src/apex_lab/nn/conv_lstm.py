"""Convolutional LSTM (Shi et al. 2015) over feature maps of a video."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.slots import may_look


class ConvLSTM(nn.Module):
    """One ConvLSTM layer with as many hidden as input channels.

    The convolution over the inputs does not depend on time, so it runs once for all frames; only the hidden state's
    convolution is inside the loop.

    Args:
        channels: of the feature map, in and out.
        kernel: side of both convolutions.
        forget: bias of the forget gate at the start; None: drawn, as all biases of a convolution.
    """

    def __init__(self, channels: int, kernel: int = 3, forget: float | None = 1.0) -> None:
        super().__init__()
        self.from_input = nn.Conv2d(channels, 4 * channels, kernel, padding=kernel // 2)
        self.from_hidden = nn.Conv2d(channels, 4 * channels, kernel, padding=kernel // 2, bias=False)
        if forget is not None:  # start by remembering: forget gates half open would blur the first steps
            with torch.no_grad():
                assert self.from_input.bias is not None
                self.from_input.bias[channels : 2 * channels] = forget

    def forward(
        self, features: Float[Tensor, "B T C h w"], state: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Float[Tensor, "B T C h w"], tuple[Tensor, Tensor]]:
        """Hidden states of all frames, and hidden state and cell, each (B, C, h, w), after the last.

        Args:
            features: of the frames.
            state: hidden state and cell before the first frame; None: zero.
        """
        b, t = features.shape[:2]
        driven = self.from_input(features.flatten(0, 1)).unflatten(0, (b, t))
        hidden, cell = (torch.zeros_like(features[:, 0]) for _ in range(2)) if state is None else state
        states = []
        # of a hidden state of zeros the convolution is zero; a clip of one frame makes it, for its weights' gradient
        known = state is None and t > 1 and may_look(features)
        for i, frame in enumerate(driven.unbind(1)):
            hidden, cell = gated(frame, cell) if known and i == 0 else self.step(frame, hidden, cell)
            states.append(hidden)
        return torch.stack(states, dim=1), (hidden, cell)

    def step(
        self, driven: Float[Tensor, "B C4 h w"], hidden: Float[Tensor, "B C h w"], cell: Float[Tensor, "B C h w"]
    ) -> tuple[Float[Tensor, "B C h w"], Float[Tensor, "B C h w"]]:
        """One frame: `from_input` of its features and the states before it -> hidden state and cell after it."""
        return gated(driven + self.from_hidden(hidden), cell)


def gated(
    gates: Float[Tensor, "B C4 h w"], cell: Float[Tensor, "B C h w"]
) -> tuple[Float[Tensor, "B C h w"], Float[Tensor, "B C h w"]]:
    """Input, forget and output gate and candidate, before their squashing, and the cell -> hidden state and cell."""
    gates_in, forget, out, candidate = gates.chunk(4, dim=1)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(gates_in) * torch.tanh(candidate)
    return torch.sigmoid(out) * torch.tanh(cell), cell

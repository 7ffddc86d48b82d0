"""The background: a sequential VAE of whole images that sees no objects (gswm.md section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.models.gswm.latents import gaussian
from apex_lab.models.gswm.networks import Decoder, Encoder
from apex_lab.nn.blocks import mlp
from apex_lab.nn.distributions import kl_gaussian
from apex_lab.nn.precision import full

Count = Annotated[int, Field(gt=0)]


class BackgroundState(NamedTuple):
    """Both LSTMs after a frame, each (B, hidden): hidden and cell state of the posterior's, then of the prior's."""

    q_hidden: Tensor
    q_cell: Tensor
    p_hidden: Tensor
    p_cell: Tensor


class Backdrop(NamedTuple):
    """images (B, T, 3, H, W): RGB in [0, 1]; kl (B, T): nats; state: after the last frame."""

    images: Tensor
    kl: Tensor
    state: BackgroundState


class Background(nn.Module):
    """Video -> background images.

    z_ctx of a frame is sampled from a posterior that sees the frame and the LSTM's state before it; then both LSTMs
    read the sample. Only the posterior's chain is a loop: the encoder sees all frames at once, and so do, once the
    samples are there, the prior's LSTM and the decoder.

    Args:
        image_size: H = W in pixels, a multiple of 16.
        latent: length of z_ctx.
        hidden: of the LSTMs, the perceptrons and the code of an image.
        widths: channels of the encoder.
        decoder_widths: channels of the decoder, from the coarsest level to the finest.
    """

    def __init__(
        self,
        image_size: Count,
        latent: Count = 128,
        hidden: Count = 128,
        widths: Sequence[Count] = (64, 128, 256, 512),
        decoder_widths: Sequence[Count] = (128, 64, 32, 16),
    ) -> None:
        super().__init__()
        self.latent = latent
        self.encoder = Encoder(image_size, widths, hidden, first_kernel=7, name="background.image_size")
        self.decoder = Decoder(latent, image_size, decoder_widths, 3, activation=False, name="background.image_size")
        self.q_net = mlp([2 * hidden, hidden, hidden, 2 * latent])
        self.p_net = mlp([hidden, hidden, hidden, 2 * latent])
        self.q_cell = nn.LSTMCell(latent, hidden)
        self.p_lstm = nn.LSTM(latent, hidden, batch_first=True)
        self.start = nn.Parameter(torch.randn(4, hidden))

    def forward(
        self,
        video: Float[Tensor, "B T 3 H W"],
        noise: Float[Tensor, "B T ctx"],
        state: BackgroundState | None = None,
    ) -> Backdrop:
        """RGB in [0, 1] and standard normal numbers -> `Backdrop`."""
        b, t = video.shape[:2]
        if state is None:
            state = BackgroundState(*self.start[:, None].expand(-1, b, -1))
        codes = self.encoder(video.flatten(0, 1)).unflatten(0, (b, t))
        q_hidden, q_cell = state.q_hidden, state.q_cell
        raws, samples = [], []
        for code, drawn in zip(codes.unbind(1), noise.unbind(1), strict=True):
            raw = self.q_net(torch.cat([q_hidden, code], dim=-1))
            q = gaussian(raw)
            z = q.mean + q.std * drawn
            q_hidden, q_cell = self.q_cell(z, (q_hidden, q_cell))
            raws.append(raw)
            samples.append(z)
        z = torch.stack(samples, dim=1)
        start = (state.p_hidden[None].contiguous(), state.p_cell[None].contiguous())
        after, (p_hidden, p_cell) = self.p_lstm(z, start)
        before = torch.cat([state.p_hidden[:, None], after[:, :-1]], dim=1)
        kl = kl_gaussian(gaussian(torch.stack(raws, dim=1)), gaussian(self.p_net(before)))
        images = full(self.decoder(z.flatten(0, 1))).unflatten(0, (b, t))
        return Backdrop(images, kl, BackgroundState(q_hidden, q_cell, p_hidden[0], p_cell[0]))

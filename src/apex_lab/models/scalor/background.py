"""Background: posterior from what objects leave unexplained, recurrent prior, decoders (scalor.md section 10)."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import GROUPS, enlarged, halved, same
from apex_lab.models.scalor.latents import gaussian_of
from apex_lab.nn.celu_stack import run_layers
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.precision import full
from apex_lab.nn.splitting import joined, part_size

DecoderKind = Literal["strong", "weak"]

LEVELS = {
    32: ((128, 4), (64, 2), (16, 4)),
    64: ((128, 4), (64, 4), (16, 4)),
    128: ((256, 4), (128, 4), (64, 2), (16, 4)),
}
"""Channels and enlargement of the decoder's levels by image size; 64 and 128 are published."""


def background_encoder(image_size: int, latent: int) -> nn.Sequential:
    """[x_t, 1 - A] -> means, then raw standard deviations (N, 2 latent, 1, 1)."""
    layers: list[nn.Module] = []
    channels, side = 4, image_size
    for width in (16, 32, 64, 64, 64):
        if side > 4:
            layers += halved(channels, width)
            channels, side = width, side // 2
    return nn.Sequential(*layers, nn.Conv2d(channels, 2 * latent, 4))


def strong_decoder(image_size: int, latent: int) -> nn.Sequential:
    """z_bg (N, latent, 1, 1) -> RGB image before the logistic function."""
    layers = same(latent, 256, kernel=1)
    channels = 256
    for width, factor in LEVELS[image_size]:
        layers += [*enlarged(channels, width, factor), *same(width, width)]
        channels = width
    return nn.Sequential(*layers, *same(channels, channels), nn.Conv2d(channels, 3, 3, padding=1))


class WeakDecoder(nn.Module):
    """Broadcasts z_bg over the image: can draw smooth backgrounds, but hardly objects.

    Args:
        image_size: H = W in pixels.
        latent: length of z_bg.
    """

    def __init__(self, image_size: int, latent: int) -> None:
        super().__init__()
        self.image_size = image_size
        layers: list[nn.Module] = []
        channels = latent + 2
        for _ in range(3 if image_size >= 128 else 2):
            layers += [nn.Conv2d(channels, 64, 5, padding=2), nn.CELU(inplace=True), nn.GroupNorm(GROUPS[64], 64)]
            channels = 64
        self.stack = nn.Sequential(*layers, nn.Conv2d(channels, 3, 3, padding=1))

    def forward(self, latent: Float[Tensor, "N Z 1 1"]) -> Float[Tensor, "N 3 H W"]:
        axis = torch.linspace(-1, 1, self.image_size, device=latent.device, dtype=latent.dtype)
        row, column = torch.meshgrid(axis, axis, indexing="ij")
        n = len(latent)
        spread = latent.expand(-1, -1, self.image_size, self.image_size)
        return run_layers(self.stack, torch.cat([torch.stack([row, column]).expand(n, -1, -1, -1), spread], dim=1))


class Background(nn.Module):
    """The background component.

    Args:
        image_size: H = W in pixels.
        latent: length of z_bg.
        decoder: the published default is the strong one.
        hidden: of the prior's GRU.
    """

    def __init__(self, image_size: int, latent: int, decoder: DecoderKind, hidden: int = 32) -> None:
        super().__init__()
        self.latent = latent
        self.encoder = background_encoder(image_size, latent)
        weak = decoder == "weak"
        self.decoder: nn.Module = WeakDecoder(image_size, latent) if weak else strong_decoder(image_size, latent)
        self.prior_rnn = nn.GRUCell(latent, hidden)
        self.prior_head = nn.Linear(hidden, 2 * latent)
        self.largest = (64 if weak else 16) * image_size**2

    def posterior(self, images: Float[Tensor, "N 3 H W"], foreground: Float[Tensor, "N H W"]) -> Gaussian:
        """q(z_bg) of frames, given A; gradients go through A to the objects."""
        seen = torch.cat([images, 1 - foreground[:, None]], dim=1)
        size = part_size(len(seen), 16 * (seen.shape[-1] // 2) ** 2, seen)
        return gaussian_of(joined(run_layers(self.encoder, part) for part in seen.split(size)).flatten(1))

    def draw(self, latent: Float[Tensor, "N Z"]) -> Float[Tensor, "N 3 H W"]:
        """RGB in [0, 1]."""
        size = part_size(len(latent), self.largest, latent)
        parts = (part[..., None, None] for part in latent.split(size))
        decoder = self.decoder
        if isinstance(decoder, nn.Sequential):
            return joined(torch.sigmoid(full(run_layers(decoder, part))) for part in parts)
        return joined(torch.sigmoid(full(decoder(part))) for part in parts)

    def prior(
        self, latent: Float[Tensor, "B T Z"], before: tuple[Tensor, Tensor] | None
    ) -> tuple[Gaussian, tuple[Tensor, Tensor]]:
        """p(z_bg) of every frame given the samples of the frames before, and what the next chunk starts from.

        Args:
            latent: samples of all frames.
            before: sample of the last frame and the GRU's state at it; None at the start of a video, where the prior
                is N(0, 1) and the state zero.
        """
        if before is None:
            hidden = latent.new_zeros(len(latent), self.prior_rnn.hidden_size)
            means, stds = [torch.zeros_like(latent[:, 0])], [torch.ones_like(latent[:, 0])]
            fed = list(latent[:, :-1].unbind(1))
        else:
            last, hidden = before
            means, stds = [], []
            fed = [last, *latent[:, :-1].unbind(1)]
        states = []
        for sample in fed:
            hidden = self.prior_rnn(sample, hidden)
            states.append(hidden)
        if states:
            change = gaussian_of(self.prior_head(torch.stack(states, dim=1)))
            means += (torch.stack(fed, dim=1) + change.mean).unbind(1)
            stds += change.std.unbind(1)
        return Gaussian(torch.stack(means, dim=1), torch.stack(stds, dim=1)), (latent[:, -1], hidden)

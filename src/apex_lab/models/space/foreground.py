"""The foreground: a grid of cells, each with at most one object, inferred in parallel (space.md sections 2-4, 7, 8)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.space.composition import (
    KERNEL,
    Composition,
    boundary_kernel,
    boundary_loss,
    compose,
)
from apex_lab.models.space.latents import (
    BOUND,
    Cells,
    kl_presence,
    relaxed_presence,
    split_gaussian,
    windows_of,
)
from apex_lab.models.space.networks import GlimpseDecoder, GlimpseEncoder, ImageEncoder
from apex_lab.nn.distributions import Gaussian, kl_gaussian, standard_normal
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import Paster, crop, for_paste
from apex_lab.nn.splitting import joined, part_size
from apex_lab.scene import Noise, Schedule


class Drawn(NamedTuple):
    """What the foreground draws of n images: see `Composition`, and the glimpses' RGB (n, N, 3, g, g)."""

    composition: Composition
    colours: Tensor
    paster: Paster


class Foreground(nn.Module):
    """Posterior, decoder and KL of the N = G^2 cells.

    Args:
        image_size: H = W in pixels.
        grid: G.
        glimpse_size: g, side of crops and decoded glimpses in pixels, 16 or 32.
        what: length of z_what.
        scale_std: standard deviation of the prior of z_scale.
    """

    def __init__(self, image_size: int, grid: int, glimpse_size: int, what: int, scale_std: float) -> None:
        super().__init__()
        self.image_size, self.glimpse_size, self.scale_std = image_size, glimpse_size, scale_std
        self.encoder = ImageEncoder(image_size, grid)
        self.presence = nn.Conv2d(128, 1, 1)
        self.depth = nn.Conv2d(128, 2, 1)
        self.scale = nn.Conv2d(128, 4, 1)
        self.shift = nn.Conv2d(128, 4, 1)
        self.glimpse_encoder = GlimpseEncoder(glimpse_size, what)
        self.glimpse_decoder = GlimpseDecoder(glimpse_size, what)
        # fixed, but a parameter as in the published code, whose count includes it
        self.boundary_kernel = nn.Parameter(boundary_kernel(), requires_grad=False)

    def infer(
        self, images: Float[Tensor, "n 3 H W"], schedule: Schedule, noise: Noise
    ) -> tuple[Cells, dict[str, Float[Tensor, " n"]]]:
        """Samples of all cells, and the KL terms summed over cells.

        No KL is weighted by presence: an empty cell pays for every latent that differs from its prior.
        """
        features = self.encoder(images)
        # heads -> (n, N, D), cells row-major
        logit, depth, scale, shift = (
            head(features).flatten(2).transpose(1, 2) for head in (self.presence, self.depth, self.scale, self.shift)
        )
        logit = BOUND * torch.tanh(full(logit).squeeze(-1))
        q_depth, q_scale, q_shift = split_gaussian(depth), split_gaussian(scale, 1e-15), split_gaussian(shift)
        presence = relaxed_presence(logit, schedule["temperature"], noise)
        z_depth = q_depth.sample(noise)
        windows = windows_of(q_scale.sample(noise), q_shift.sample(noise))
        q_what = split_gaussian(self._look(images, windows))
        # z_scale's prior is on the value before the sigmoid
        p_scale = Gaussian(
            schedule["scale_prior"].expand_as(q_scale.mean), torch.full_like(q_scale.std, self.scale_std)
        )
        kl_where = kl_gaussian(q_scale, p_scale) + kl_gaussian(q_shift, standard_normal(q_shift.mean))
        terms = {
            "kl_pres": kl_presence(logit, schedule["presence_prior"]).sum(1),
            "kl_depth": kl_gaussian(q_depth, standard_normal(q_depth.mean)).sum(1),
            "kl_where": kl_where.sum(1),
            "kl_what": kl_gaussian(q_what, standard_normal(q_what.mean)).sum(1),
        }
        cells = Cells(torch.sigmoid(logit), presence, z_depth.squeeze(-1), windows, q_what.sample(noise))
        return cells, terms

    def _look(self, images: Tensor, windows: Tensor) -> Tensor:
        """Crops of the image itself -> raw posterior of z_what (n, N, 2 Z)."""
        cells = windows.shape[1]
        with torch.autocast(images.device.type, enabled=False):  # positions in half precision miss pixels
            size = part_size(len(images), cells * 3 * images.shape[-1] * self.glimpse_size, images)
            crops = joined(
                crop(part, where, self.glimpse_size).flatten(0, 1)
                for part, where in zip(images.split(size), windows.split(size), strict=True)
            )
        return self.glimpse_encoder(crops).unflatten(0, (-1, cells))

    def draw(self, cells: Cells) -> Drawn:
        """Decodes all cells and composes the foreground."""
        n, count = cells.presence.shape
        mask, colour = self.glimpse_decoder(cells.what.flatten(0, 1))
        mask, colour = full(mask).unflatten(0, (n, count)), full(colour).unflatten(0, (n, count))
        paster = self._paster(cells, self.glimpse_size)
        masked = mask * cells.presence[..., None, None, None]
        return Drawn(compose(masked, colour, cells.depth, paster), colour, paster)

    def boundary(self, cells: Cells, drawn: Drawn) -> Float[Tensor, " n"]:
        """Boundary loss of each image (section 7)."""
        paster = drawn.paster if self.glimpse_size == KERNEL else self._paster(cells, KERNEL)
        return boundary_loss(self.boundary_kernel, cells.presence, drawn.composition.alpha, paster)

    def _paster(self, cells: Cells, size: int) -> Paster:
        return Paster(for_paste(cells.windows), size, self.image_size)

"""Discovery: proposals of new objects in every cell, and which of them are accepted (scalor.md section 7)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import halved, halvings, same
from apex_lab.models.scalor.composition import paster_of
from apex_lab.models.scalor.encoder import FEATURES
from apex_lab.models.scalor.glimpses import GlimpseEncoder
from apex_lab.models.scalor.latents import GUARD, Sampler, bounded_logit, full_precision, gaussian_of
from apex_lab.models.scalor.recompute import Recompute
from apex_lab.models.scalor.windowed import overlaps, places_of, reached
from apex_lab.models.scalor.windows import SizeRule, discovered
from apex_lab.nn.celu_stack import fast_on
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import for_paste, window_of
from apex_lab.nn.splitting import part_size

MASK_CODE = 32


class Proposals(NamedTuple):
    """Proposed objects of a frame's D cells with their posteriors; (B, D, ...).

    what, where, depth, presence: samples; presence is that before rejection.
    q_where (of the raw z_where), q_what, q_depth: Gaussians. logit (B, D): of the presence.
    """

    what: Tensor
    where: Tensor
    depth: Tensor
    presence: Tensor
    q_where: Gaussian
    q_what: Gaussian
    q_depth: Gaussian
    logit: Tensor


class MaskEncoder(nn.Sequential):
    """Mask of the propagated objects -> code per cell.

    Args:
        image_size: H = W in pixels.
        grid: G.
    """

    def __init__(self, image_size: int, grid: int) -> None:
        levels = halvings(image_size, grid)
        layers = [*halved(1, 16), *halved(16, 32), *same(32, 32)]
        channels = 32
        if levels > 2:
            layers += [*halved(32, 64), *same(64, 64)]
            channels = 64
        for level in range(3, levels):
            if level > 3:
                layers += same(64, 64)
            layers += halved(64, 64)
        super().__init__(*layers, *same(channels, MASK_CODE, kernel=1))


class Discovery(nn.Module):
    """q of new objects, given e_t and a mask of what propagated objects explain already.

    Args:
        image_size: H = W in pixels.
        grid: G; D = G^2 cells.
        size: rule of a box's size.
        deep_heads: heads with a hidden layer (images of 128 px).
    """

    def __init__(self, image_size: int, grid: int, size: SizeRule, deep_heads: bool) -> None:
        super().__init__()
        self.grid, self.size = grid, size
        self.mask_encoder = MaskEncoder(image_size, grid)
        self.fusion = nn.Sequential(
            *same(FEATURES + MASK_CODE, 64, kernel=1, groups=16), *same(64, 64, kernel=1, groups=16)
        )

        def head(hidden: int, outputs: int) -> nn.Sequential:
            if deep_heads:
                return nn.Sequential(*same(64, hidden, kernel=1), nn.Conv2d(hidden, outputs, 1))
            return nn.Sequential(nn.Conv2d(64, outputs, 1))

        self.where, self.presence, self.depth = head(64, 8), head(64, 1), head(32, 2)

    def forward(
        self,
        features: Float[Tensor, "B 64 G G"],
        explained: Float[Tensor, "B H W"],
        image: Float[Tensor, "B 3 H W"],
        encoder: GlimpseEncoder,
        sampler: Sampler,
        recompute: Recompute,
    ) -> Proposals:
        """Proposals of all cells; no gradient goes to `explained`."""
        code = self.mask_encoder(for_convolutions(explained.detach()[:, None]))
        q = self.fusion(torch.cat([features, code], dim=1))

        def cells(head: nn.Module) -> Float[Tensor, "B D outputs"]:
            return head(q).flatten(2).transpose(1, 2)

        q_where = gaussian_of(cells(self.where))
        where = discovered(sampler.gaussian(q_where), self.size, self.grid)
        q_what = gaussian_of(recompute(encoder, image, window_of(where)))
        what = sampler.gaussian(q_what)
        q_depth = gaussian_of(cells(self.depth))
        depth = sampler.gaussian(q_depth)
        logit = bounded_logit(cells(self.presence))
        presence = sampler.presence(logit)
        return Proposals(what, where, depth, presence, q_where, q_what, q_depth, logit.squeeze(-1))


class Rejection:
    """Drops proposals that explain what propagated objects explain already.

    Args:
        alpha: a pixel belongs to a proposal if its mask is above this,
        explained: and to propagated objects if the sum of their masks is above this.
        ratio: a proposal is kept if less than this share of its pixels is explained.
    """

    def __init__(self, alpha: float = 0.3, explained: float = 0.1, ratio: float = 0.3) -> None:
        self.alpha, self.explained, self.ratio = alpha, explained, ratio

    @torch.no_grad()
    def in_question(
        self, windows: Float[Tensor, "B D 4"], explained: Float[Tensor, "B H W"], glimpse: int
    ) -> Bool[Tensor, "B D"]:
        """Which proposals reach an explained pixel; all others are kept, whatever their masks of `glimpse` pixels."""
        places = places_of(for_paste(full(windows)), explained.shape[-1])
        taken = (explained > self.explained).to(places.y.dtype)
        y, x = (inside.to(taken.dtype) for inside in reached(places, glimpse))
        return ((y @ taken) * x).sum(-1) > 0

    @torch.no_grad()
    def kept(
        self,
        alpha: Float[Tensor, "B D g g"],
        windows: Float[Tensor, "B D 4"],
        explained: Float[Tensor, "B H W"],
    ) -> Bool[Tensor, "B D"]:
        """Which proposals are kept; one whose mask has no pixel is.

        Args:
            alpha: masks of the proposals, without their presence.
            windows: (s_y, s_x, t_y, t_x).
            explained: sum of the propagated objects' masks.
        """
        with full_precision(alpha):
            size = explained.shape[-1]
            taken = (explained > self.explained).to(full(alpha).dtype)
            if fast_on(alpha):
                mine, shared = overlaps(full(alpha), places_of(for_paste(full(windows)), size), self.alpha, taken)
                return shared / (mine + GUARD) < self.ratio
            taken = taken.flatten(1)[..., None]
            each = part_size(alpha.shape[1], size * size * len(alpha), alpha)
            shares = []
            for some, places in zip(alpha.split(each, 1), windows.split(each, 1), strict=True):
                maps = paster_of(places, alpha.shape[-1], size).each(full(some[:, :, None])).flatten(2)
                mine = (maps > self.alpha).to(maps.dtype)
                shares.append((mine @ taken).squeeze(-1) / (mine.sum(-1) + GUARD))
        return torch.cat(shares, dim=1) < self.ratio


def room(valid: Bool[Tensor, "B P"], limit: int) -> Int[Tensor, " B"]:
    """How many new objects a video may have in a frame, given the slots that hold one already; at least 0."""
    return (limit - valid.sum(1)).clamp_min(0)

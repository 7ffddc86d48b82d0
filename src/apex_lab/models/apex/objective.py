"""APEX's loss terms, one value per video, summed over frames (Eq. 19-22; signs put right: everything is minimised)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from apex_lab.models.apex.masks import Masks
from apex_lab.models.apex.objects import Beliefs, Proposals
from apex_lab.models.apex.windows import size_logit
from apex_lab.nn.distributions import Gaussian, kl_bernoulli, kl_gaussian, standard_normal

Positive = Annotated[float, Field(gt=0)]


class DiscoveryPrior:
    """p(z_what), p(z_where) of discovered objects (Eq. 6); their presence prior comes from the schedule.

    Args:
        size: mean window size as a share of the image side.
        size_std: standard deviation of the size's logit.
    """

    def __init__(self, size: Annotated[float, Field(gt=0, lt=1)] = 1 / 6, size_std: Positive = 1.0) -> None:
        self.size, self.size_std = size, size_std

    def where(self, like: Float[Tensor, "... 4"]) -> Gaussian:
        """z_where ~ N(mean size, size_std) for the sizes and N(0, 1) (free within reach) for the centre."""
        # filled on the device: numbers copied there would make the host wait
        size, centre = like.split(2, dim=-1)
        return Gaussian(
            torch.cat([torch.full_like(size, size_logit(self.size)), torch.zeros_like(centre)], dim=-1),
            torch.cat([torch.full_like(size, self.size_std), torch.ones_like(centre)], dim=-1),
        )


Direction = Literal["inclusive", "exclusive"]


def kl(q: Gaussian, p: Gaussian, direction: Direction) -> Float[Tensor, "..."]:
    """Inclusive KL(p || q), which the paper minimises for z_what and z_where, or exclusive KL(q || p)."""
    return kl_gaussian(p, q) if direction == "inclusive" else kl_gaussian(q, p)


def kl_terms(
    propagated: Beliefs,
    valid: Bool[Tensor, "B T P"],
    presence: Float[Tensor, "B T P"],
    proposals: Proposals,
    discovery_prob: Float[Tensor, "B T D"],
    discovery_prior: Float[Tensor, "B T D"],
    discovery_pres: Float[Tensor, "B T D"],
    prior: DiscoveryPrior,
    direction: Direction,
) -> dict[str, Float[Tensor, " B"]]:
    """KL terms of all foreground objects, summed over frames (Eq. 3): their part of Eq. 20.

    Those of z_what and z_where are weighted by presence, the exponents of Eq. 5 (propagated) and Eq. 6 (discovered).

    Args:
        propagated, valid, presence: of the P slots; slots that came into the frame empty cost nothing.
        proposals, discovery_prob, discovery_prior, discovery_pres: of all D cells.
        prior: of discovered objects.
        direction: of the KL of z_what and z_where.
    """
    held = torch.where(valid, presence, torch.zeros_like(presence))

    def total(per_object: Tensor) -> Tensor:
        return per_object.flatten(1).sum(1)

    found_what = discovery_pres * kl(proposals.q_what, standard_normal(proposals.q_what.mean), direction)
    found_where = discovery_pres * kl(proposals.q_where, prior.where(proposals.q_where.mean), direction)
    stay = kl_bernoulli(propagated.q_pres, propagated.p_pres)
    return {
        "kl_what": total(found_what) + total(held * kl(propagated.q_what, propagated.p_what, direction)),
        "kl_where": total(found_where) + total(held * kl(propagated.q_where, propagated.p_where, direction)),
        "kl_pres": total(kl_bernoulli(discovery_prob, discovery_prior))
        + total(torch.where(valid, stay, torch.zeros_like(stay))),
    }


def mask_entropy(masks: Masks) -> Float[Tensor, "..."]:
    """L_H = sum over pixels and objects of -m_fg m_k log m_k (Eq. 21), per frame (any leading shape)."""
    # x log x -> 0: where a mask underflows (or is -inf, an absent component), its log is replaced before multiplying.
    log_objects = masks.log_objects.masked_fill(masks.log_objects < -60, 0.0)
    return -(masks.foreground * (masks.objects * log_objects).sum(-3)).sum((-2, -1))


SEEN = 0.3
"""A pixel belongs to what a window should fit where its mask is above this: faint smears stretch no window."""

FEWEST = 8
"""Pixels that a mask must cover before its window is judged by it."""


def loose_windows(
    masks: Float[Tensor, "N K H W"],
    place: Float[Tensor, "N K 4"],
    presence: Float[Tensor, "N K"],
    margin: float = 1.6,
) -> Float[Tensor, " N"]:
    """How much larger windows are than their own masks, and how far off their centres. Not in the paper.

    The likelihood alone does not shrink a window: what is drawn in a smaller one is worse until the decoders have
    learned it. So all windows stay as large as they start, hold several things, and a small thing beside a large one is
    proposed by no cell. Per component and axis, with s the window's size and t its centre, c the mean of the mask's
    pixels and f = margin * sqrt(3) * their standard deviation, the size of a block of pixels with a margin:

        max(0, log s - log f)^2 + ((t - c) / (2 f))^2

    summed over both axes and all components, each as often as it is present. Masks and presence get no gradient.

    Args:
        masks: in [0, 1].
        place: as in windows.py.
        presence: in [0, 1]; zero for slots that hold nothing.
        margin: room around the mask, of its size.
    """
    height, width = masks.shape[-2:]
    seen = masks.detach() * (masks.detach() > SEEN)
    rows = _mean_and_deviation(seen.sum(-1))
    columns = _mean_and_deviation(seen.sum(-2))
    centre, deviation = (torch.stack(pair, dim=-1) for pair in zip(rows, columns, strict=True))
    smallest = 4 / max(height, width)  # a window smaller than a few pixels has next to no gradient
    fit = (margin * math.sqrt(3) * deviation).clamp(smallest, 0.95)
    size, middle = place.split(2, dim=-1)
    too_large = (F.logsigmoid(size) - fit.log()).clamp_min(0).square()
    off = ((middle - centre) / (2 * fit)).square()
    judged = presence.detach() * (seen.sum((-2, -1)) > FEWEST)
    return ((too_large + off).sum(-1) * judged).sum(-1)


def _mean_and_deviation(profile: Float[Tensor, "... n"]) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Of positions in [-1, 1], n pixels with these weights; each pixel is as wide as it is."""
    n = profile.shape[-1]
    at = (2 * torch.arange(n, device=profile.device, dtype=profile.dtype) + 1) / n - 1
    share = profile / profile.sum(-1, keepdim=True).clamp_min(1e-6)
    mean = share @ at
    variance = (share * (at - mean[..., None]).square()).sum(-1) + 1 / (3 * n**2)
    return mean, variance.sqrt()

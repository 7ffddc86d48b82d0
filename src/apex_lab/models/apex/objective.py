"""APEX's loss terms, one value per video, summed over frames (Eq. 19-22; signs put right: everything is minimised)."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
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

"""The KL terms of the objects (gswm.md sections 5 and 6)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from apex_lab.models.gswm.discovery import Posterior, beliefs
from apex_lab.models.gswm.latents import WHERE, gaussian, kl_bernoulli
from apex_lab.models.gswm.propagation import Propagated, Propagation
from apex_lab.nn.distributions import Gaussian, kl_gaussian, standard_normal


def where_prior(like: Float[Tensor, "... 4"], scale_mean: Float[Tensor, ""], scale_std: float) -> Gaussian:
    """N((m, m, 0, 0), (v, v, 1, 1)): prior of the raw z_where of a discovery."""
    is_size = torch.arange(WHERE, device=like.device) < 2
    return Gaussian(torch.where(is_size, scale_mean, 0.0), torch.where(is_size, scale_std, 1.0))


def discovery_terms(
    posterior: Posterior,
    mask: Bool[Tensor, "B T"] | None,
    what: int,
    schedule: Mapping[str, Tensor],
    scale_std: float,
) -> dict[str, Float[Tensor, " B"]]:
    """KL of all cells, rejected, dropped and absent ones too, in the frames that discover; nats.

    Depth, where and what count in proportion to the sampled presence; presence and dynamics are paid by every cell.
    """
    q = beliefs(posterior.rest, posterior.dyna, what)
    cells = {
        "kl_pres": kl_bernoulli(posterior.prob, schedule["presence_prior"]),
        "kl_depth": posterior.pres * kl_gaussian(q.depth, standard_normal(q.depth.mean)),
        "kl_where": posterior.pres * kl_gaussian(q.where, where_prior(q.where.mean, schedule["scale_mean"], scale_std)),
        "kl_what": posterior.pres * kl_gaussian(q.what, standard_normal(q.what.mean)),
        "kl_dyna": kl_gaussian(q.dyna, standard_normal(q.dyna.mean)),
    }
    counts = 1.0 if mask is None else mask.to(torch.float32)
    return {name: (value.sum(-1) * counts).sum(1) for name, value in cells.items()}


def propagation_terms(
    propagated: Propagated | None,
    propagation: Propagation,
    schedule: Mapping[str, Tensor],
    like: Float[Tensor, "B ..."],
) -> dict[str, Float[Tensor, " B"]]:
    """KL of all propagated slots, present or not; nats. None: no frame had any.

    `presence_cost` is no KL of the model, which has no prior of a tracked object's presence: the published code charges
    it as an auxiliary loss.
    """
    if propagated is None:
        return {name: like.new_zeros(len(like), dtype=torch.float32) for name in ("kl_propagation", "presence_cost")}
    kl = kl_gaussian(gaussian(propagated.raw_dyna), propagation.prior(propagated.p_hidden))
    cost = kl_bernoulli(propagated.prob, schedule["presence_prior"])
    return {"kl_propagation": kl.flatten(1).sum(1), "presence_cost": cost.flatten(1).sum(1)}

"""KL terms of a video, weighted as published (scalor.md section 12)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.models.scalor.latents import kl_presence, kl_standard
from apex_lab.models.scalor.propagation import PropagationPrior
from apex_lab.models.scalor.rollout import Step, gaussians
from apex_lab.nn.distributions import kl_gaussian

REJECTED_PRIOR = 1e-8
"""Prior probability of the presence of a rejected proposal."""

Terms = dict[str, Float[Tensor, " B"]]


def _video(frames: list[Tensor]) -> Tensor:
    return torch.stack(frames, dim=1)


def discovery_terms(steps: list[Step], prior: Float[Tensor, ""]) -> Terms:
    """KL of all cells' latents, summed over cells and frames.

    What, where and depth are weighted by the presence before rejection and cap; gradients go through the weight.

    Args:
        steps: all frames.
        prior: presence probability of a proposal that is not rejected.
    """
    proposals = [step.proposals for step in steps]
    weight = _video([p.presence for p in proposals]).squeeze(-1)
    accepted = _video([step.accepted for step in steps]).float()
    expected = prior * accepted + REJECTED_PRIOR * (1 - accepted)
    terms = {
        "kl_what": weight * kl_standard(gaussians([p.q_what for p in proposals])),
        "kl_where": weight * kl_standard(gaussians([p.q_where for p in proposals])),
        "kl_depth": weight * kl_standard(gaussians([p.q_depth for p in proposals])),
        "kl_pres": kl_presence(_video([p.logit for p in proposals]), expected),
    }
    return {name: value.sum((1, 2)) for name, value in terms.items()}


def propagation_terms(steps: list[Step], network: PropagationPrior) -> Terms:
    """KL of the propagated objects' latents against their priors, summed over slots and frames.

    What, where and depth are weighted by the presence after the stop rule; gradients go through the weight.
    """
    frames = [step.propagated for step in steps if step.propagated is not None]
    if not frames:
        return {}
    alive = _video([step.alive for step in steps if step.propagated is not None])
    # The heads of the prior are no part of the recurrence: all frames at once.
    p_what, p_where, p_depth, p_presence = network.heads(_video([f.objects.prior_h for f in frames]))
    weight = _video([f.objects.presence for f in frames]).squeeze(-1)
    terms = {
        "kl_what": weight * kl_gaussian(gaussians([f.what for f in frames]), p_what),
        "kl_where": weight * kl_gaussian(gaussians([f.where for f in frames]), p_where),
        "kl_depth": weight * kl_gaussian(gaussians([f.depth for f in frames]), p_depth),
        "kl_pres": kl_presence(_video([f.logit for f in frames]), p_presence),
    }
    return {name: torch.where(alive, value, torch.zeros_like(value)).sum((1, 2)) for name, value in terms.items()}


def added(first: Terms, second: Terms) -> Terms:
    """Sums of terms; a term that `second` lacks is zero there."""
    return {name: value + second[name] if name in second else value for name, value in first.items()}

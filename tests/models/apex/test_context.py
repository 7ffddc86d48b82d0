"""p_context and the foreground mask against sums over PyTorch's own spatial transformer, pixel by pixel."""

from __future__ import annotations

import math

import pytest
import torch

from apex_lab.models.apex.masks import ApexNormalisation, ScalorNormalisation
from apex_lab.models.apex.objects import context_probability
from apex_lab.nn.spatial_transformer import Paster
from tests.models.apex import naive
from tests.models.apex.small import Inside, lively, video

G, SIZE = 8, 16


def windows(k: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    size = 0.15 + 0.6 * torch.rand(1, k, 2, generator=generator)
    return torch.cat([size, 2 * torch.rand(1, k, 2, generator=generator) - 1], -1).to(dtype)


@pytest.mark.parametrize("seed", range(3))
def test_context_given_propagated_objects_pixel_by_pixel(seed: int) -> None:
    """Eq. 8 from two propagated objects alone, then Eq. 18 for four proposals."""
    g = torch.Generator().manual_seed(seed)
    masks = ApexNormalisation()
    old, new = windows(2, g), windows(4, g)
    alpha_old, alpha_new = (masks.logits(3 * torch.randn(1, k, G, G, generator=g).double()) for k in (2, 4))
    presence = torch.rand(1, 2, generator=g).double()
    scope = 1 - masks.foreground(alpha_old, presence, Paster(old, G, SIZE))
    got = context_probability(scope, masks.claim(alpha_new, Paster(new, G, SIZE)))
    glimpses = torch.log(1 + alpha_old.exp()) * presence[..., None, None]
    pasted = [naive.paste(glimpses[0, k][None], old[0, k], SIZE)[0].tolist() for k in range(2)]
    for k in range(4):
        logits = naive.paste(alpha_new[0, k][None], new[0, k], SIZE)[0].tolist()
        inside = naive.paste(torch.ones(1, G, G).double(), new[0, k], SIZE)[0].tolist()
        above = below = 0.0
        for i in range(SIZE):
            for j in range(SIZE):
                m_p = math.tanh(sum(p[i][j] for p in pasted))
                weight = math.tanh(math.log(1 + math.exp(logits[i][j]))) * inside[i][j]
                above += (1 - m_p) * weight
                below += weight
        assert float(got[0, k]) == pytest.approx(above / below, rel=1e-6)


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
@pytest.mark.parametrize("seed", range(5))
def test_context_is_exactly_one_with_nothing_propagated(
    masks: ApexNormalisation | ScalorNormalisation, seed: int
) -> None:
    g = torch.Generator().manual_seed(seed)
    alpha = masks.logits(3 * torch.randn(1, 16, G, G, generator=g))
    window = windows(16, g, torch.float32)
    window[0, :2, :2] = 0.018  # too small to hold a pixel's centre: claims nothing, and nothing is explained of it
    nothing = masks.foreground(alpha, torch.zeros(1, 16), Paster(window, G, SIZE))
    assert (nothing == 0).all()
    assert (context_probability(1 - nothing, masks.claim(alpha, Paster(window, G, SIZE))) == 1).all()


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
def test_context_of_a_cell_that_repeats_a_solid_object_is_near_zero(
    masks: ApexNormalisation | ScalorNormalisation,
) -> None:
    window = torch.tensor([[[0.5, 0.4, -0.2, 0.1], [0.5, 0.4, 0.6, 0.7]]])
    paster = Paster(window, 16, 32)
    alpha = masks.logits(torch.full((1, 2, 16, 16), 8.0))
    scope = 1 - masks.foreground(alpha, torch.tensor([[1.0, 0.0]]), paster)
    context = context_probability(scope, masks.claim(alpha, paster))
    assert context[0, 0] < 0.05
    assert context[0, 1] > 0.9  # its window touches the first one's


def test_context_lies_between_zero_and_one_and_falls_as_more_is_explained() -> None:
    g = torch.Generator().manual_seed(9)
    masks = ApexNormalisation()
    window = windows(6, g, torch.float32)
    alpha = masks.logits(3 * torch.randn(1, 6, G, G, generator=g))
    paster = Paster(window, G, SIZE)
    claims = masks.claim(alpha, paster)
    before = torch.ones(1, 6)
    for presence in (0.0, 0.01, 0.1, 0.5, 1.0):
        context = context_probability(1 - masks.foreground(alpha, torch.full((1, 6), presence), paster), claims)
        assert ((context >= 0) & (context <= 1)).all()
        assert (context <= before).all()
        before = context
    assert (before < 0.9).any()


def test_the_first_frame_s_presence_is_its_proposal_in_the_whole_model() -> None:
    with torch.no_grad():
        run = Inside(lively().eval(), video())
    assert torch.equal(run.steps.discovery_prob[:, 0], run.proposals.prob[:, 0])
    assert (run.steps.discovery_prob[:, 1:] <= run.proposals.prob[:, 1:]).all()
    assert (run.steps.discovery_prob[:, 1:] < 0.5 * run.proposals.prob[:, 1:]).any()

"""What only training mode does: latents are drawn from q, presences at the scheduled temperature, and the curriculum.

Draws are compared with the distributions that they are drawn from, over thousands of them; the gradient of the whole
objective with finite differences under the same noise, in float64.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex.masks import ApexNormalisation, MaskNormalisation, ScalorNormalisation
from apex_lab.models.apex.slots import gather_slots
from apex_lab.models.apex.windows import MAX_LOGIT
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import Context
from tests.models.apex.small import SCHEDULE, Inside, lively, video

SLOTS = 3


def copies(count: int, frames: int = 3) -> Tensor:
    """The same video again and again: what differs between them is noise."""
    return video(1, frames).repeat(count, 1, 1, 1, 1)


def schedule(**changes: float) -> dict[str, Tensor]:
    return SCHEDULE | {name: torch.tensor(value) for name, value in changes.items()}


def trained(count: int, **changes: float) -> Inside:
    model = lively().train()
    with torch.no_grad():
        return Inside(model, copies(count), schedule(**changes))


def assert_standard_normal(z: Tensor) -> None:
    """Mean, standard deviation and kurtosis of many draws, within five standard errors."""
    n = z.numel()
    assert n > 1000
    assert abs(z.mean().item()) < 5 / math.sqrt(n)
    assert abs(z.std().item() - 1) < 5 / math.sqrt(2 * n)
    assert abs(z.pow(4).mean().item() - 3) < 5 * math.sqrt(96 / n)


def test_latents_are_drawn_from_their_posteriors() -> None:
    torch.manual_seed(0)
    model, kept = lively().train(), list[Gaussian]()
    posterior = model.background.posterior

    def listen(*inputs: Tensor) -> Gaussian:
        kept.append(posterior(*inputs))
        return kept[-1]

    model.background.posterior = listen  # type: ignore[method-assign]
    with torch.no_grad():
        inside = Inside(model, copies(120), schedule(discover=1.0))
    found, steps = inside.proposals, inside.steps

    assert_standard_normal((found.what - found.q_what.mean) / found.q_what.std)
    size = MAX_LOGIT * torch.atanh(found.place[..., :2].double() / MAX_LOGIT)
    assert_standard_normal((size - found.q_where.mean[..., :2]) / found.q_where.std[..., :2])

    [q] = kept
    assert_standard_normal((inside.z_background.flatten(0, 1) - q.mean) / q.std)

    alive, believed = steps.alive, steps.propagated
    assert_standard_normal(((steps.what[:, :, :SLOTS] - believed.q_what.mean) / believed.q_what.std)[alive])
    before = gather_slots(steps.place[:, :-1].flatten(0, 1), steps.source[:, :-1].flatten(0, 1))
    change = (steps.place[:, 1:, :SLOTS] - before.unflatten(0, (120, -1)))[..., :2].double()
    step = torch.atanh(change / model.discovery.windows.size_step)
    q_mean, q_std = (x[:, 1:, :, :2] for x in believed.q_where)
    assert_standard_normal(((step - q_mean) / q_std)[alive[:, 1:]])


@pytest.mark.parametrize("temperature", [0.4, 1.0, 2.5])
def test_presences_are_relaxed_bernoulli_at_the_scheduled_temperature(temperature: float) -> None:
    torch.manual_seed(1)
    steps = trained(120, temperature=temperature, discover=1.0).steps
    q, p = steps.propagated.q_pres[steps.alive], steps.discovery_prob.flatten()
    z, pres = steps.presence[:, :, :SLOTS][steps.alive], steps.discovery_pres.flatten()
    possible = (p > 1e-3) & (p < 1 - 1e-3)
    for prob, drawn in ((q, z), (p[possible], pres[possible])):
        assert len(prob) > 300
        for x in (-2.0, -0.5, 0.0, 1.0, 2.0):
            # z < sigmoid((x + logit q) / temperature) exactly where the logistic noise is below x
            below = (drawn < torch.sigmoid((x + torch.logit(prob)) / temperature)).float().mean().item()
            expected = 1 / (1 + math.exp(-x))
            assert abs(below - expected) < 5 * math.sqrt(expected * (1 - expected) / len(prob))


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_videos_are_carried_on_with_the_scheduled_probability(share: float) -> None:
    torch.manual_seed(2)
    steps = trained(300, carry=share, discover=1.0).steps
    held = steps.carried.any(-1)[:, :-1]  # something could be carried on
    enters = steps.alive.any(-1)[:, 1:]
    assert held.sum() > 200
    assert not enters[~held].any()
    ratio = enters[held].float().mean().item()
    assert abs(ratio - share) <= 5 * math.sqrt(share * (1 - share) / held.sum().item())
    # all slots of a video or none
    both = steps.alive[:, 1:][enters] == steps.carried[:, :-1][enters]
    assert both.all()


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_carried_videos_may_discover_with_the_scheduled_probability(share: float) -> None:
    torch.manual_seed(3)
    steps = trained(300, carry=1.0, discover=share).steps
    closed = (steps.discovery_prob == 0).all(-1)
    assert not closed[:, 0].any(), "the first frame is always open"
    assert torch.equal(closed, (steps.discovery_prior == 0).all(-1))
    assert (steps.discovery_pres[closed] == 0).all()
    opened = 1 - closed[:, 1:].float().mean().item()
    assert abs(opened - share) <= 5 * math.sqrt(share * (1 - share) / closed[:, 1:].numel())


def test_evaluation_knows_no_curriculum_and_no_noise() -> None:
    model = lively().eval()
    with torch.no_grad():
        one, other = (
            Inside(model, video(2, 4), schedule(carry=c, discover=d, temperature=t)).scene
            for c, d, t in ((0.0, 0.0, 0.1), (1.0, 1.0, 2.0))
        )
    assert torch.equal(one.masks, other.masks)
    assert torch.equal(one.ids, other.ids)


PROBED = (
    "discovery.head_pres.2.bias",  # p_proposal, Eq. 17
    "discovery.head_where.bias",
    "appearance.head.bias",
    "mask_decoder.head.0.bias",  # p_context, Eq. 18, and the scope, beside the masks
    "propagation.head_pres.2.bias",
    "propagation.head_where.2.bias",
    "propagation.prior_pres.2.bias",
)


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()], ids=["apex", "scalor"])
@pytest.mark.parametrize("name", PROBED)
def test_gradient_of_the_objective_against_finite_differences(name: str, masks: MaskNormalisation) -> None:
    model = lively(masks=masks).double().train()
    x = video(2, 3).double()
    values = {k: v.double() for k, v in schedule(carry=1.0, discover=1.0).items()}
    weight = model.get_parameter(name)
    along = torch.randn(weight.shape, generator=torch.Generator().manual_seed(4)).double()
    if name == "discovery.head_where.bias":
        # centres that would leave the image are held there while their gradient passes (`keep_in_image`)
        along.view(2, 4)[:, 2:] = 0

    def objective() -> Tensor:
        torch.manual_seed(5)
        return sum((term.sum() for term in model(x, Context(values)).terms.values()), start=x.new_zeros(()))

    [gradient] = torch.autograd.grad(objective(), [weight])
    analytic = (gradient * along).sum().item()
    h, ends = 1e-7, []
    with torch.no_grad():
        for sign in (1, -1):
            weight.add_(sign * h * along)
            ends.append(objective().item())
            weight.sub_(sign * h * along)
    assert analytic != 0
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(analytic, rel=2e-4)

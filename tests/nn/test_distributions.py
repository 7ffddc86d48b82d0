"""Closed forms against Monte Carlo and torch.distributions."""

import math

import pytest
import torch
from torch.distributions import Bernoulli, Normal, RelaxedBernoulli, kl_divergence

from apex_lab.nn.distributions import (
    LOG_GUARD,
    Gaussian,
    gaussian_from,
    kl_bernoulli,
    kl_gaussian,
    relaxed_bernoulli,
    relaxed_logit,
)
from apex_lab.scene import Noise


def test_kl_gaussian_both_directions_against_monte_carlo() -> None:
    torch.manual_seed(0)
    a = Gaussian(torch.randn(3, dtype=torch.float64), 0.5 + torch.rand(3, dtype=torch.float64))
    b = Gaussian(torch.randn(3, dtype=torch.float64), 0.5 + torch.rand(3, dtype=torch.float64))
    for p, q in [(a, b), (b, a)]:
        x = p.mean + p.std * torch.randn(1_000_000, 3, dtype=torch.float64)
        sampled = (Normal(*p).log_prob(x) - Normal(*q).log_prob(x)).sum(-1)
        error = 5 * sampled.std() / 1000
        assert (kl_gaussian(p, q) - sampled.mean()).abs() < error
        torch.testing.assert_close(kl_gaussian(p, q), kl_divergence(Normal(*p), Normal(*q)).sum(-1))
    assert kl_gaussian(a, a) == 0


def test_narrow_posterior_costs_fifty_nats_a_dimension_under_the_inclusive_kl() -> None:
    q = Gaussian(torch.zeros(1), torch.full((1,), 0.1))
    p = Gaussian(torch.zeros(1), torch.ones(1))
    assert 46 < kl_gaussian(p, q) < 50
    assert kl_gaussian(q, p) < 2


def test_kl_bernoulli() -> None:
    q = torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64)
    p = torch.tensor([0.6, 0.001, 0.5], dtype=torch.float64)
    torch.testing.assert_close(kl_bernoulli(q, p), kl_divergence(Bernoulli(q), Bernoulli(p)))
    assert kl_bernoulli(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0])).isfinite().all()


def test_kl_bernoulli_of_certain_things_in_half_precision() -> None:
    q, p = torch.tensor([0.0, 0.9995, 1.0, 1.0]), torch.tensor([0.25, 0.5, 0.5, 0.0])
    half = q.bfloat16().requires_grad_()  # all but the first round to 1 or are it
    found = kl_bernoulli(half, p.bfloat16())
    torch.testing.assert_close(found, kl_bernoulli(q.bfloat16().float(), p))
    found.sum().backward()
    assert half.grad is not None
    assert half.grad.isfinite().all()


def test_relaxed_bernoulli_is_above_one_half_as_often_as_it_should() -> None:
    torch.manual_seed(1)
    for prob in (0.03, 0.4, 0.95):
        z = relaxed_bernoulli(torch.full((200_000,), prob), torch.tensor(0.7), Noise())
        assert abs((z > 0.5).double().mean() - prob) < 0.004
    cold = relaxed_bernoulli(torch.full((10_000,), 0.5), torch.tensor(0.01), Noise())
    assert ((cold < 0.01) | (cold > 0.99)).double().mean() > 0.9


def test_gaussian_from_bounds_the_standard_deviation() -> None:
    d = gaussian_from(torch.tensor([[1.0, 2.0, -100.0, 100.0]]))
    assert d.mean.tolist() == [[1.0, 2.0]]
    assert (d.std > 0).all()
    assert d.std.max() <= 5


@pytest.mark.parametrize("prob", [0.02, 0.5, 0.9])
@pytest.mark.parametrize("temperature", [0.3, 1.0])
def test_relaxed_bernoulli_has_the_distribution_of_torch_s(prob: float, temperature: float) -> None:
    """Against the closed-form cumulative distribution of samples, and against the density that torch gives."""
    torch.manual_seed(2)
    n = 100_000
    z = relaxed_bernoulli(torch.full((n,), prob, dtype=torch.float64), torch.tensor(temperature), Noise()).sort().values
    # P(z <= x) = sigmoid(temperature logit(x) - logit(prob)); Kolmogorov-Smirnov at a level of 1e-4
    logit = torch.logit(torch.tensor(prob, dtype=torch.float64))
    expected = torch.sigmoid(temperature * torch.logit(z) - logit)
    assert (expected - torch.arange(1, n + 1) / n).abs().max() < 2.23 / n**0.5

    theirs = RelaxedBernoulli(torch.tensor(temperature).double(), probs=torch.tensor(prob).double())
    x = torch.linspace(0.05, 0.95, 10_001, dtype=torch.float64)
    inside = torch.trapezoid(theirs.log_prob(x).exp(), x)
    assert abs(((z > 0.05) & (z <= 0.95)).double().mean() - inside) < 5 * 0.5 / n**0.5


def test_relaxed_bernoulli_gives_gradients_to_the_probability_alone() -> None:
    prob = torch.tensor([0.0, 1e-9, 0.3, 1.0], requires_grad=True)
    z = relaxed_bernoulli(prob, torch.tensor(0.3), Noise())
    z.sum().backward()
    assert prob.grad is not None
    assert prob.grad.isfinite().all()
    assert prob.grad[2] > 0
    assert ((z >= 0) & (z <= 1)).all()


def test_gaussian_samples_have_their_mean_and_spread_and_the_mean_is_what_evaluation_takes() -> None:
    torch.manual_seed(3)
    d = Gaussian(torch.tensor([1.0, -2.0]).expand(200_000, 2), torch.tensor([0.5, 2.0]).expand(200_000, 2))
    z = d.sample(Noise())
    torch.testing.assert_close(z.mean(0), d.mean[0], rtol=0, atol=0.03)
    torch.testing.assert_close(z.std(0), d.std[0], rtol=0.02, atol=0)
    assert d.sample(None) is d.mean


def test_kl_bernoulli_against_monte_carlo_in_both_directions() -> None:
    torch.manual_seed(4)
    a, b = torch.tensor(0.3, dtype=torch.float64), torch.tensor(0.8, dtype=torch.float64)
    for q, p in [(a, b), (b, a)]:
        x = (torch.rand(400_000, dtype=torch.float64) < q).double()
        sampled = Bernoulli(q).log_prob(x) - Bernoulli(p).log_prob(x)
        assert (kl_bernoulli(q, p) - sampled.mean()).abs() < 5 * sampled.std() / len(x) ** 0.5
    assert kl_bernoulli(a, a) == 0


def test_kl_bernoulli_with_a_guard_inside_the_logarithms() -> None:
    """A prior of 1e-10 is kept as it is, where the clamp of the default makes it 1e-6."""
    one, rare = torch.tensor(1.0), torch.tensor(1e-10)
    assert float(kl_bernoulli(one, rare, added=LOG_GUARD)) == pytest.approx(10 * math.log(10), rel=1e-5)
    assert float(kl_bernoulli(one, rare)) == pytest.approx(6 * math.log(10), rel=1e-3)
    q, p = torch.tensor([0.0, 0.3, 1.0]), torch.tensor(0.2)
    want = [-math.log(0.8), 0.3 * math.log(0.3 / 0.2) + 0.7 * math.log(0.7 / 0.8), -math.log(0.2)]
    assert kl_bernoulli(q, p, added=LOG_GUARD).tolist() == pytest.approx(want, rel=1e-5)


def test_relaxed_logit() -> None:
    """(logit of the probability + logit of the uniform number) / temperature, with both kept from 0 and 1."""
    prob, u = torch.tensor([0.3, 0.5, 0.0]), torch.tensor([0.5, 0.9, 1.0])
    got = relaxed_logit(prob, torch.tensor(0.5), u, 0.01)
    assert got.tolist() == pytest.approx([2 * math.log(0.3 / 0.7), 2 * math.log(9), 0.0], abs=1e-4)

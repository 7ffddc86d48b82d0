"""Closed forms against Monte Carlo and torch.distributions."""

import torch
from torch.distributions import Bernoulli, Normal, kl_divergence

from apex_lab.nn.distributions import Gaussian, gaussian_from, kl_bernoulli, kl_gaussian, relaxed_bernoulli


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


def test_relaxed_bernoulli_is_above_one_half_as_often_as_it_should() -> None:
    torch.manual_seed(1)
    for prob in (0.03, 0.4, 0.95):
        z = relaxed_bernoulli(torch.full((200_000,), prob), torch.tensor(0.7))
        assert abs((z > 0.5).double().mean() - prob) < 0.004
    cold = relaxed_bernoulli(torch.full((10_000,), 0.5), torch.tensor(0.01))
    assert ((cold < 0.01) | (cold > 0.99)).double().mean() > 0.9


def test_gaussian_from_bounds_the_standard_deviation() -> None:
    d = gaussian_from(torch.tensor([[1.0, 2.0, -100.0, 100.0]]))
    assert d.mean.tolist() == [[1.0, 2.0]]
    assert (d.std > 0).all()
    assert d.std.max() <= 5

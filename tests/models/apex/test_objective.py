"""KL bookkeeping, entropy loss, scope and context, windows: against direct loops."""

import math

import pytest
import torch
from torch.distributions import Bernoulli, Normal, kl_divergence

from apex_lab.models.apex.masks import ApexNormalisation
from apex_lab.models.apex.objective import DiscoveryPrior, kl_terms, mask_entropy
from apex_lab.models.apex.objects import Beliefs, Proposals, context_probability, scope_in_windows
from apex_lab.models.apex.windows import Windows, square_of, window_of
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.spatial_transformer import Paster, paste


def gaussian(*shape: int) -> Gaussian:
    return Gaussian(torch.randn(*shape, dtype=torch.float64), 0.2 + torch.rand(*shape, dtype=torch.float64))


@pytest.mark.parametrize("direction", ["inclusive", "exclusive"])
def test_kl_terms_against_a_loop(direction: str) -> None:
    torch.manual_seed(0)
    b, t, p, d, z = 2, 3, 2, 4, 5
    beliefs = Beliefs(
        gaussian(b, t, p, 4),
        gaussian(b, t, p, 4),
        gaussian(b, t, p, z),
        gaussian(b, t, p, z),
        torch.rand(b, t, p).double(),
        torch.rand(b, t, p).double(),
    )
    valid = torch.rand(b, t, p) < 0.5
    presence = torch.rand(b, t, p).double()
    empty = torch.zeros(0)
    proposals = Proposals(gaussian(b, t, d, 4), gaussian(b, t, d, z), empty, empty, empty, empty)
    prob, prior_prob, pres = (torch.rand(b, t, d).double() for _ in range(3))
    prior = DiscoveryPrior(0.2, 0.7)
    got = kl_terms(beliefs, valid, presence, proposals, prob, prior_prob, pres, prior, direction)  # type: ignore[arg-type]

    def one(q: Gaussian, p: Gaussian, index: tuple[int, ...]) -> float:
        a, c = Normal(q.mean[index], q.std[index]), Normal(p.mean[index], p.std[index])
        return float((kl_divergence(c, a) if direction == "inclusive" else kl_divergence(a, c)).sum())

    logit = math.log(0.2 / 0.8)
    shape = (b, t, d, 4)
    where = Gaussian(
        torch.tensor([logit, logit, 0, 0]).double().expand(shape), torch.tensor([0.7, 0.7, 1, 1]).double().expand(shape)
    )
    what = Gaussian(torch.zeros(b, t, d, z).double(), torch.ones(b, t, d, z).double())
    for i in range(b):
        want = {"kl_what": 0.0, "kl_where": 0.0, "kl_pres": 0.0}
        for j in range(t):
            for k in range(p):
                if valid[i, j, k]:
                    want["kl_what"] += presence[i, j, k] * one(beliefs.q_what, beliefs.p_what, (i, j, k))
                    want["kl_where"] += presence[i, j, k] * one(beliefs.q_where, beliefs.p_where, (i, j, k))
                    want["kl_pres"] += kl_divergence(
                        Bernoulli(beliefs.q_pres[i, j, k]), Bernoulli(beliefs.p_pres[i, j, k])
                    )
            for k in range(d):
                want["kl_what"] += pres[i, j, k] * one(proposals.q_what, what, (i, j, k))
                want["kl_where"] += pres[i, j, k] * one(proposals.q_where, where, (i, j, k))
                want["kl_pres"] += kl_divergence(Bernoulli(prob[i, j, k]), Bernoulli(prior_prob[i, j, k]))
        for name, value in want.items():
            torch.testing.assert_close(got[name][i], torch.as_tensor(value).double(), rtol=1e-6, atol=1e-6)


def test_entropy_loss_against_a_direct_loop() -> None:
    torch.manual_seed(1)
    b, k, g, size = 2, 3, 8, 10
    windows = torch.cat([0.3 + 0.6 * torch.rand(b, k, 2), torch.rand(b, k, 2) - 0.5], -1).double()
    valid = torch.tensor([[True, True, True], [True, False, True]])
    out = ApexNormalisation().compose(
        3 * torch.randn(b, k, g, g).double(), torch.rand(b, k).double(), valid, Paster(windows, g, size)
    )
    got = mask_entropy(out)
    for i in range(b):
        want = 0.0
        for y in range(size):
            for x in range(size):
                for j in range(k):
                    m = float(out.objects[i, j, y, x])
                    if m > 0:
                        want -= float(out.foreground[i, y, x]) * m * math.log(m)
        assert abs(float(got[i]) - want) < 1e-9 * max(1.0, want)


def test_context_is_one_with_nothing_propagated_and_near_zero_for_a_repeated_object() -> None:
    masks = ApexNormalisation()
    g, size = 16, 32
    windows = torch.tensor([[[0.4, 0.4, -0.3, 0.2], [0.3, 0.3, 0.6, -0.6]]])
    axis = torch.linspace(-1, 1, g)
    blob = 5 * torch.tanh(4 * (0.6 - (axis[:, None] ** 2 + axis[None] ** 2).sqrt()) * 3)
    alpha = blob.expand(1, 2, g, g)
    paster = Paster(windows, g, size)
    claims = masks.claim(alpha, paster)
    nothing = 1 - masks.foreground(alpha, torch.zeros(1, 2), paster)
    assert (nothing == 1).all()
    torch.testing.assert_close(context_probability(nothing, claims), torch.ones(1, 2), rtol=0, atol=1e-6)
    first_explained = 1 - masks.foreground(alpha, torch.tensor([[1.0, 0.0]]), paster)
    context = context_probability(first_explained, claims)
    assert context[0, 0] < 0.1
    assert context[0, 1] > 0.99


def test_context_against_the_equation() -> None:
    torch.manual_seed(2)
    g, size = 8, 12
    windows = torch.cat([0.2 + 0.5 * torch.rand(1, 3, 2), torch.rand(1, 3, 2) - 0.5], -1).double()
    alpha = 3 * torch.randn(1, 3, g, g).double()
    scope = torch.rand(1, size, size).double()
    got = context_probability(scope, ApexNormalisation().claim(alpha, Paster(windows, g, size)))
    for k in range(3):
        warped = paste(alpha[:, k, None], windows[:, k], size)[0, 0]
        inside = paste(torch.ones_like(alpha[:, k, None]), windows[:, k], size)[0, 0]
        weight = torch.tanh(torch.log(1 + warped.exp())) * inside
        want = sum(scope[0, i, j] * weight[i, j] for i in range(size) for j in range(size)) / weight.sum()
        torch.testing.assert_close(got[0, k], want, rtol=1e-5, atol=1e-6)


def test_scope_in_windows_is_the_mean_scope_inside() -> None:
    scope = torch.zeros(1, 8, 8)
    scope[:, :, 4:] = 1
    rows, columns = Paster(torch.tensor([[[1.0, 1.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.5]]]), 8, 8).inside()
    torch.testing.assert_close(scope_in_windows(scope, rows, columns), torch.tensor([[0.5, 1.0]]), rtol=0, atol=0.06)


def test_a_window_that_holds_no_pixel_centre_is_fully_open() -> None:
    """To the prior as to p_context: else discovering there would cost what no evidence can pay."""
    paster = Paster(torch.tensor([[[0.02, 0.02, 0.0, 0.0], [0.4, 0.4, 0.0, 0.0]]]), 8, 8)
    rows, columns = paster.inside()
    assert rows[0, 0].sum() == 0
    scope, claims = torch.zeros(1, 8, 8), ApexNormalisation().claim(torch.ones(1, 2, 8, 8), paster)
    assert scope_in_windows(scope, rows, columns).tolist() == [[1.0, 0.0]]
    torch.testing.assert_close(context_probability(scope, claims), torch.tensor([[1.0, 0.0]]), rtol=0, atol=1e-5)


def test_windows() -> None:
    windows = Windows(grid=4, reach=1.5, size_step=0.3, centre_step=0.2)
    still = torch.tensor([[-1.0, 0.3, 0.5, -0.9]])
    torch.testing.assert_close(windows.propagated(still, torch.zeros(1, 4)), still)
    far = windows.propagated(still, torch.full((1, 4), 100.0))
    torch.testing.assert_close(far, still + torch.tensor([[0.3, 0.3, 0.2, 0.2]]))
    assert windows.cells.tolist()[0] == [-0.75, -0.75]
    found = windows.discovered(torch.zeros(1, 16, 4))
    torch.testing.assert_close(found[0, :, 2:], windows.cells)
    extreme = windows.discovered(torch.full((1, 16, 4), 50.0))
    assert (extreme[..., 2:].abs() <= 1).all()
    assert torch.allclose(extreme[0, 0, 2:], windows.cells[0] + 1.5 * 0.5)
    assert (window_of(extreme)[..., :2] < 0.983).all()
    wide = torch.tensor([[0.2, 0.6, 0.1, -0.1]])
    torch.testing.assert_close(square_of(wide), torch.tensor([[0.6, 0.6, 0.1, -0.1]]))


def test_a_centre_held_at_the_border_keeps_its_gradient() -> None:
    windows = Windows(grid=4, reach=1.5, size_step=0.3, centre_step=0.2)
    z = torch.tensor([[0.0, 0.0, 1.0, 0.0]], requires_grad=True)
    place = windows.propagated(torch.tensor([[0.0, 0.0, 1.0, 0.0]]), z)
    assert place[0, 2] == 1
    place[0, 2].backward()
    assert z.grad is not None
    assert z.grad[0, 2] > 0

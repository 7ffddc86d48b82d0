"""KL bookkeeping, entropy loss, scope and context, windows: against direct loops."""

import math

import pytest
import torch
from torch.distributions import Bernoulli, Normal, kl_divergence

from apex_lab.models.apex.masks import ApexNormalisation
from apex_lab.models.apex.objective import DiscoveryPrior, kl_terms, loose_windows, mask_entropy
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


def block(size: int, top: int, bottom: int, left: int, right: int, value: float = 1.0) -> torch.Tensor:
    mask = torch.zeros(size, size, dtype=torch.float64)
    mask[top:bottom, left:right] = value
    return mask


def place_of(height: float, width: float, y: float, x: float) -> torch.Tensor:
    size = torch.tensor([height, width], dtype=torch.float64).logit()
    return torch.cat([size, torch.tensor([y, x], dtype=torch.float64)])


def test_a_window_that_fits_its_block_of_pixels_is_not_loose() -> None:
    # rows 4 to 12 and columns 8 to 24 of 32: shares 1/4 and 1/2 of the side, centres -1/2 and 0
    masks, one = block(32, 4, 12, 8, 24)[None, None], torch.ones(1, 1, dtype=torch.float64)
    fits = place_of(1.6 / 4, 1.6 / 2, -0.5, 0.0)
    assert float(loose_windows(masks, fits[None, None], one)) == pytest.approx(0, abs=1e-12)
    smaller = place_of(0.2, 0.2, -0.5, 0.0)
    assert float(loose_windows(masks, smaller[None, None], one)) == pytest.approx(0, abs=1e-12)
    loose = place_of(0.8, 0.9, -0.3, 0.25)
    wanted = math.log(2) ** 2 + math.log(0.9 / 0.8) ** 2 + (0.2 / 0.8) ** 2 + (0.25 / 1.6) ** 2
    assert float(loose_windows(masks, loose[None, None], one)) == pytest.approx(wanted, rel=1e-9)
    assert float(loose_windows(masks, loose[None, None], 0.5 * one)) == pytest.approx(wanted / 2, rel=1e-9)


def test_loose_windows_against_a_loop_over_pixels() -> None:
    torch.manual_seed(4)
    n, k, size = 2, 3, 16
    masks = torch.rand(n, k, size, size).double()
    place = torch.cat([torch.randn(n, k, 2), torch.rand(n, k, 2) * 2 - 1], -1).double()
    presence = torch.rand(n, k).double()
    masks[0, 1] = block(size, 3, 5, 3, 6)  # six pixels: too few to judge a window by
    masks[1, 2] = block(size, 0, 9, 0, 9, 0.25)  # a smear
    got = loose_windows(masks, place, presence, margin=1.5)
    for i in range(n):
        want = 0.0
        for j in range(k):
            seen = [(y, x, float(m)) for y, row in enumerate(masks[i, j]) for x, m in enumerate(row) if m > 0.3]
            total = sum(m for *_, m in seen)
            if total <= 8:
                continue
            for axis in (0, 1):
                at = [((2 * pixel[axis] + 1) / size - 1, pixel[2]) for pixel in seen]
                mean = sum(a * m for a, m in at) / total
                variance = sum((a - mean) ** 2 * m for a, m in at) / total + 1 / (3 * size**2)
                fit = min(max(1.5 * math.sqrt(3 * variance), 4 / size), 0.95)
                share = 1 / (1 + math.exp(-float(place[i, j, axis])))
                loose = max(0.0, math.log(share / fit)) ** 2 + ((float(place[i, j, 2 + axis]) - mean) / (2 * fit)) ** 2
                want += float(presence[i, j]) * loose
        assert float(got[i]) == pytest.approx(want, rel=1e-9)


def test_loose_windows_move_windows_alone() -> None:
    masks = block(16, 2, 8, 2, 8)[None, None].repeat(1, 2, 1, 1).requires_grad_()
    presence = torch.tensor([[1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    place = torch.stack([place_of(0.8, 0.8, 0.1, 0.1)] * 2)[None].requires_grad_()
    to_masks, to_presence, to_place = torch.autograd.grad(
        loose_windows(masks, place, presence).sum(), (masks, presence, place), allow_unused=True
    )
    assert to_masks is None
    assert to_presence is None
    assert (to_place[0, 0] > 0).all()  # smaller, and up and left
    assert (to_place[0, 1] == 0).all()  # absent

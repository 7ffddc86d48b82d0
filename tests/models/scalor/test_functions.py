"""Functions of SCALOR by number, against the published implementation and by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.scalor.background import Background
from apex_lab.models.scalor.composition import clamped, layers_of, log_likelihood, paster_of
from apex_lab.models.scalor.discovery import Rejection, room
from apex_lab.models.scalor.latents import (
    Sampler,
    bounded_logit,
    gaussian_of,
    kl_presence,
    kl_standard,
    relaxed_logit,
)
from apex_lab.models.scalor.propagation import gated
from apex_lab.models.scalor.windows import AnchoredSize, FreeSize, discovered, propagated, window_of
from apex_lab.nn.distributions import Gaussian, kl_gaussian
from apex_lab.nn.spatial_transformer import crop_weights
from apex_lab.scene import Noise
from apex_lab.training.schedules import Exponential, Linear
from tests.models.scalor.fixture import array


def _crop(image: Tensor, where: Tensor, height: int, width: int) -> Tensor:
    s_y, s_x, t_y, t_x = window_of(where).unbind(-1)
    rows = crop_weights(s_y, t_y, image.shape[-2], height)[:, None]
    columns = crop_weights(s_x, t_x, image.shape[-1], width)[:, None]
    return rows @ image @ columns.transpose(-1, -2)


def test_crop() -> None:
    where = array("stn/z_where").requires_grad_()
    got = _crop(array("stn/image"), where, 8, 6)
    torch.testing.assert_close(got, array("stn/forward_8x6"), rtol=0, atol=1e-4)
    (gradient,) = torch.autograd.grad(got.square().sum(), where)
    want = array("stn/forward_sumsq_grad_z_where")
    torch.testing.assert_close(gradient, want, rtol=1e-3, atol=1e-3 * float(want.abs().max()))


def test_paste() -> None:
    where = array("stn/z_where").requires_grad_()
    wide = paster_of(window_of(where), 8, 16)
    high = paster_of(window_of(where), 8, 12)
    wide.w_y = high.w_y  # the images of the fixture are 12 x 16
    rows = wide.w_y.transpose(-1, -2)[:, None] @ array("stn/glimpse") @ wide.w_x[:, None]
    torch.testing.assert_close(rows, array("stn/inverse_12x16"), rtol=0, atol=1e-4)
    (gradient,) = torch.autograd.grad(rows.square().sum(), where)
    # At s = 1/2, t = 0 every pixel falls exactly on one of the glimpse, where bilinear sampling has a kink: any of the
    # two slopes will do.
    gradient, want = gradient[1:], array("stn/inverse_sumsq_grad_z_where")[1:]
    torch.testing.assert_close(gradient, want, rtol=1e-3, atol=1e-3 * float(want.abs().max()))


def test_boxes_of_discovery() -> None:
    raw = array("disc_where/official_g8/raw").flatten(2).transpose(1, 2)
    got = discovered(raw, AnchoredSize(), 8)[0]
    torch.testing.assert_close(got, array("disc_where/official_g8/z_where"), rtol=0, atol=1e-5)


def test_boxes_of_propagation() -> None:
    before = torch.tensor([[[0.1, 0.2, 0.5, 1.0], [0.1, 0.2, -0.5, -1.04]]])
    raw = torch.tensor([[[0.0, 0.0, math.atanh(0.5), 9.0], [0.5, -0.5, 0.0, -9.0]]])
    got = propagated(raw, before, AnchoredSize())
    torch.testing.assert_close(got[0, 0], torch.tensor([0.1 / math.sqrt(2.5), 0.1 * math.sqrt(2.5), 0.6, 1.05]))
    size, root = 0.1 + 0.03 * math.tanh(0.5), math.sqrt(2.5 - 0.5 * math.tanh(0.5))
    torch.testing.assert_close(got[0, 1], torch.tensor([size / root, size * root, -0.5, -1.05]))


def test_published_boxes_are_pedestrians() -> None:
    corners = torch.tensor([[-99.0, -99.0], [-99.0, 99.0], [99.0, -99.0], [99.0, 99.0]])
    size = 128 * AnchoredSize()(corners)
    assert 5.1 < float(size[:, 0].min()) < float(size[:, 0].max()) < 11.9
    assert 12.6 < float(size[:, 1].min()) < float(size[:, 1].max()) < 28.9


def test_free_boxes_have_any_size() -> None:
    rule = FreeSize(smallest=0.03)
    got = rule(torch.tensor([[-50.0, 50.0], [0.0, 0.0]]))
    torch.testing.assert_close(got, torch.tensor([[0.03, 1.0], [0.515, 0.515]]))
    assert float(FreeSize(0.05, -1.5)(torch.zeros(1, 2))[0, 0]) == pytest.approx(0.05 + 0.95 / (1 + math.exp(1.5)))


def test_refuses_boxes_of_no_size() -> None:
    with pytest.raises(ValueError, match=r"size_range=0.5 must be below size=0.1"):
        AnchoredSize(size_range=0.5)
    with pytest.raises(ValueError, match=r"ratio_range=2.5 must be below ratio=2.5"):
        AnchoredSize(ratio_range=2.5)


def test_gates_of_the_appearance() -> None:
    def q(name: str) -> Gaussian:
        return gaussian_of(torch.cat([array(f"prop_what/{name}_mean"), array(f"prop_what/{name}_std_raw")], dim=-1))

    got = gated(q("glimpse"), q("temporal"), array("prop_what/gates_forget_input"))
    torch.testing.assert_close(got.mean, array("prop_what/mean"), rtol=0, atol=1e-4)
    torch.testing.assert_close(got.std, array("prop_what/std"), rtol=0, atol=1e-4)
    assert float(got.std.min()) >= math.log(2)


def test_kl_of_the_presence() -> None:
    got = kl_presence(array("kl_bern/logits"), array("kl_bern/prior_prob"))
    torch.testing.assert_close(got, array("kl_bern/kl"), rtol=0, atol=1e-4)


def test_kl_of_equal_distributions_is_zero() -> None:
    logit = torch.linspace(-8, 8, 9)
    assert float(kl_presence(logit, torch.sigmoid(logit)).abs().max()) < 1e-6
    assert float(kl_standard(Gaussian(torch.zeros(1, 5), torch.ones(1, 5)))) == 0


def test_kl_against_the_standard_normal() -> None:
    q = Gaussian(torch.tensor([[0.3, -2.0]]), torch.tensor([[0.5, 1.7]]))
    torch.testing.assert_close(kl_standard(q), kl_gaussian(q, Gaussian(torch.zeros(1, 2), torch.ones(1, 2))))


@pytest.mark.parametrize("temperature", [1.0, 0.75, 0.5])
def test_relaxed_bernoulli(temperature: float) -> None:
    y = relaxed_logit(array("relaxed_bern/logits"), torch.tensor(temperature), array("relaxed_bern/u"))
    torch.testing.assert_close(y, array(f"relaxed_bern/y_tau{temperature}"), rtol=0, atol=5e-3)
    torch.testing.assert_close(torch.sigmoid(y), array(f"relaxed_bern/z_tau{temperature}"), rtol=0, atol=1e-4)


def test_standard_deviations_never_reach_zero() -> None:
    q = gaussian_of(torch.tensor([0.0, -200.0]))
    assert 0 < float(q.std) < 1e-9
    assert bool(torch.isfinite(kl_standard(q)))


def test_logits_are_bounded() -> None:
    torch.testing.assert_close(bounded_logit(torch.tensor([-99.0, 0.0, 99.0])), torch.tensor([-8.8, 0.0, 8.8]))


def test_means_in_place_of_samples() -> None:
    sampler = Sampler(None, torch.tensor(1.0))
    assert sampler.presence(torch.tensor([-0.1, 0.1])).tolist() == [0.0, 1.0]
    q = Gaussian(torch.ones(2), torch.ones(2))
    assert sampler.gaussian(q).tolist() == [1.0, 1.0]


def test_schedules() -> None:
    """The published ones count from the first step; here a step is the number of updates made before."""
    temperature, presence = Exponential(1.0, 0.5, 20000), Linear(0.099802, 0.001, 499)
    for step, value in zip(array("sched/tau_step").tolist(), array("sched/tau").tolist(), strict=True):
        assert temperature(step) == pytest.approx(value, rel=1e-5)
    for step, value in zip(array("sched/pres_prior_step").tolist(), array("sched/pres_prior").tolist(), strict=True):
        if step > 0:
            assert presence(step - 1) == pytest.approx(value, rel=1e-4)


def test_composition_of_two_equal_halves_is_dark() -> None:
    """Two components of alpha 1/2 at one depth give half of the colour and no background (section 8)."""
    drawn = torch.ones(1, 2, 4, 4, 4)
    drawn[:, :, 3] = 0.5
    whole = torch.tensor([2.0, 2.0, 0.0, 0.0]).expand(1, 2, 4)  # no border of a glimpse inside the image
    layers = layers_of(drawn, torch.ones(1, 2), torch.zeros(1, 2), whole, torch.ones(1, 2), 8)
    torch.testing.assert_close(clamped(layers.alpha), torch.ones(1, 8, 8))
    torch.testing.assert_close(layers.colour / layers.weight[:, None], torch.full((1, 3, 8, 8), 0.5))
    torch.testing.assert_close(layers.share / layers.weight, torch.full((1, 8, 8), 0.5))


def test_composition_nearer_objects_win() -> None:
    drawn = torch.ones(1, 2, 4, 4, 4)
    drawn[0, 0, :3] = 0.0  # black, near; white, far
    whole = torch.tensor([2.0, 2.0, 0.0, 0.0]).expand(1, 2, 4)
    layers = layers_of(drawn, torch.ones(1, 2), torch.tensor([[-3.0, 3.0]]), whole, torch.ones(1, 2), 8)
    near, far = torch.sigmoid(torch.tensor([3.0, -3.0]))
    torch.testing.assert_close(layers.colour / layers.weight[:, None], (far / (near + far)).expand(1, 3, 8, 8))


def test_clamp_lets_the_gradient_through() -> None:
    x = torch.tensor([[-1.0, 0.5, 3.0]], requires_grad=True)
    y = clamped(x[None])
    torch.testing.assert_close(y[0], torch.tensor([[1e-15, 0.5, 1.0]]))
    y.sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [[1.0, 1.0, 1.0]]


def test_likelihood() -> None:
    g = torch.Generator().manual_seed(0)
    x, y = torch.rand(2, 3, 4, 4, generator=g), torch.rand(2, 3, 4, 4, generator=g)
    want = torch.distributions.Normal(y, 0.1).log_prob(x).sum((1, 2, 3))
    torch.testing.assert_close(log_likelihood(x, y, 0.1), want)


def test_rejection() -> None:
    """Boxes of a quarter of the image at the left, at the right and outside; the left half is explained."""
    alpha = torch.full((1, 3, 8, 8), 0.9)
    windows = torch.tensor([[[0.5, 0.5, 0.0, -0.5], [0.5, 0.5, 0.0, 0.5], [0.2, 0.2, 5.0, 5.0]]])
    explained = torch.zeros(1, 16, 16)
    explained[..., :8] = 1.0
    assert Rejection().kept(alpha, windows, explained)[0].tolist() == [False, True, True]
    faint = 0.1 * explained
    assert Rejection().kept(alpha, windows, faint)[0].tolist() == [True, True, True], "0.1 is not above 0.1"
    assert Rejection().kept(0.3 * torch.ones_like(alpha), windows, explained)[0].tolist() == [True, True, True]


def test_room_for_new_objects() -> None:
    valid = torch.tensor([[True, True, False], [True, True, True], [False, False, False]])
    assert room(valid, 2).tolist() == [0, 0, 2]


def test_prior_of_the_background() -> None:
    """N(0, 1) at first, then the sample before plus a change; in two parts as in one."""
    torch.manual_seed(0)
    background = Background(32, 10, "strong")
    latent = torch.randn(2, 5, 10)
    whole, after = background.prior(latent, None)
    assert whole.mean[:, 0].abs().max() == 0
    assert (whole.std[:, 0] == 1).all()
    hidden = background.prior_rnn(latent[:, 0], torch.zeros(2, 32))
    change = background.prior_head(hidden)
    torch.testing.assert_close(whole.mean[:, 1], latent[:, 0] + change[:, :10])
    torch.testing.assert_close(whole.std[:, 1], torch.nn.functional.softplus(change[:, 10:]))
    first, between = background.prior(latent[:, :2], None)
    second, end = background.prior(latent[:, 2:], between)
    torch.testing.assert_close(torch.cat([first.mean, second.mean], dim=1), whole.mean)
    torch.testing.assert_close(torch.cat([first.std, second.std], dim=1), whole.std)
    torch.testing.assert_close(end[1], after[1])


def test_samples_come_from_the_noise() -> None:
    class Ones(Noise):
        def normal(self, like: Tensor) -> Tensor:
            return torch.ones_like(like)

        def uniform(self, like: Tensor) -> Tensor:
            return torch.full_like(like, 0.5)

    sampler = Sampler(Ones(), torch.tensor(0.5))
    assert sampler.gaussian(Gaussian(torch.tensor([1.0]), torch.tensor([2.0]))).tolist() == [3.0]
    torch.testing.assert_close(sampler.presence(torch.tensor([1.0])), torch.sigmoid(torch.tensor([2.0])))

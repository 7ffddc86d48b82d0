"""Likelihoods against brute-force sums in float64."""

import math

import pytest
import torch

from apex_lab.models.apex.likelihood import GaussianLikelihood, Likelihood, MixtureLikelihood, log_normal


def case(dtype: torch.dtype = torch.float64, seen: int = 1) -> tuple[torch.Tensor, ...]:
    """What a likelihood takes; `seen` images of the background."""
    g = torch.Generator().manual_seed(0)
    n, k, h, w = 2, 3, 4, 5
    share = torch.rand(n, k + 1, h, w, generator=g, dtype=torch.float64)
    share[:, 1] = 0  # an absent component
    logs = (share / share.sum(1, keepdim=True)).log()
    image = torch.rand(n, 3, h, w, generator=g, dtype=torch.float64)
    means = torch.rand(n, k, 3, h, w, generator=g, dtype=torch.float64)
    background = torch.rand(n, seen, 3, h, w, generator=g, dtype=torch.float64)
    return tuple(x.to(dtype) for x in (image, logs[:, :k], means, logs[:, k], background))


def density(x: float, mean: float, sigma: float) -> float:
    return math.exp(-0.5 * ((x - mean) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))


@pytest.mark.parametrize("seen", [1, 2])
@pytest.mark.parametrize("over", ["channel", "pixel"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
def test_mixture_against_a_loop(over: str, dtype: torch.dtype, tolerance: float, seen: int) -> None:
    fg, bg = 0.4, 0.2
    image, log_objects, means, log_background, background = case(seen=seen)
    want = torch.zeros(2, dtype=torch.float64)
    for n in range(2):
        for y in range(4):
            for x in range(5):
                p = []
                for channel in range(3):
                    value = image[n, channel, y, x].item()
                    parts = [
                        (log_objects[n, k, y, x].exp().item(), density(value, means[n, k, channel, y, x].item(), fg))
                        for k in range(3)
                    ]
                    share = log_background[n, y, x].exp().item() / seen
                    back = [(share, density(value, one[channel, y, x].item(), bg)) for one in background[n]]
                    p.append([*parts, *back])
                if over == "channel":
                    want[n] += sum(math.log(sum(m * d for m, d in row)) for row in p)
                else:
                    whole = zip(*p, strict=True)
                    want[n] += math.log(sum(rgb[0][0] * math.prod(d for _, d in rgb) for rgb in whole))
    got = MixtureLikelihood(fg, bg, over)(*case(dtype, seen))  # type: ignore[arg-type]
    torch.testing.assert_close(got.double(), want, rtol=tolerance, atol=0)


@pytest.mark.parametrize("over", ["channel", "pixel"])
def test_a_background_seen_twice_alike_is_seen_once(over: str) -> None:
    likelihood = MixtureLikelihood(0.4, 0.2, over)  # type: ignore[arg-type]
    found = []
    for times in (1, 2):
        leaves = [x.clone().requires_grad_() for x in case()]
        out = likelihood(*leaves[:4], leaves[4].expand(-1, times, -1, -1, -1)).sum()
        found.append([out, *torch.autograd.grad(out, leaves)])
    for once, twice in zip(*found, strict=True):
        torch.testing.assert_close(once, twice, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seen", [1, 2])
def test_mixture_is_stable_far_from_every_mean(seen: int) -> None:
    image, log_objects, means, log_background, background = case(torch.float32, seen)
    image = (image + 50).requires_grad_()
    out = MixtureLikelihood()(image, log_objects, means, log_background, background)
    out.sum().backward()
    assert out.isfinite().all()
    assert image.grad is not None
    assert image.grad.isfinite().all()


@pytest.mark.parametrize("seen", [1, 2])
def test_gaussian_against_torch(seen: int) -> None:
    image, log_objects, means, log_background, background = case(seen=seen)
    blend = (log_objects.exp()[:, :, None] * means).sum(1) + log_background.exp()[:, None] * background[:, seen - 1]
    want = torch.distributions.Normal(blend, 0.3).log_prob(image).sum((1, 2, 3))
    torch.testing.assert_close(GaussianLikelihood(0.3)(*case(seen=seen)), want)


def test_both_agree_where_one_component_owns_every_pixel() -> None:
    image, _, means, _, background = case()
    logs = torch.full((2, 3, 4, 5), -torch.inf, dtype=torch.float64)
    only_background = torch.zeros(2, 4, 5, dtype=torch.float64)
    a = MixtureLikelihood(0.1, 0.2)(image, logs, means, only_background, background)
    b = GaussianLikelihood(0.2)(image, logs, means, only_background, background)
    torch.testing.assert_close(a, b)


@pytest.mark.parametrize("seen", [1, 2])
def test_the_gradient_written_by_hand_equals_autograd_and_finite_differences(seen: int) -> None:
    inputs = [x.clone().requires_grad_(x.isfinite().all().item()) for x in case(seen=seen)]
    likelihood = MixtureLikelihood(0.4, 0.2)
    likelihood(*inputs).sum().backward()
    by_hand = [x.grad for x in inputs]
    again = [x.detach().clone().requires_grad_(x.requires_grad) for x in inputs]
    image, log_objects, means, log_background, background = again
    parts = log_normal(image[:, None], means, 0.4) + log_objects[:, :, None]
    back = log_normal(image[:, None], background, 0.2) + log_background[:, None, None] - math.log(seen)
    torch.logsumexp(torch.cat([parts, back], 1), 1).sum().backward()
    for got, want in zip(by_hand, [x.grad for x in again], strict=True):
        assert (got is None) == (want is None)
        if got is not None and want is not None:
            torch.testing.assert_close(got, want)
    small = [x.detach()[..., :2, :2] for x in inputs]
    small[1] = small[1].clamp_min(-20)
    assert torch.autograd.gradcheck(likelihood, [x.clone().requires_grad_() for x in small])


@pytest.mark.parametrize("likelihood", [MixtureLikelihood(), MixtureLikelihood(0.1, 0.04, "pixel")])
def test_pixels_without_any_object_are_the_background_s_and_give_objects_no_gradient(
    likelihood: MixtureLikelihood,
) -> None:
    image, _, means, _, background = case(torch.float32)
    logs = torch.full((2, 3, 4, 5), -torch.inf)
    leaves = [x.clone().requires_grad_() for x in (logs, means, torch.zeros(2, 4, 5), background)]
    out = likelihood(torch.zeros_like(image), *leaves)
    out.sum().backward()
    want = torch.distributions.Normal(background[:, 0], 0.04).log_prob(torch.zeros(())).sum((1, 2, 3))
    torch.testing.assert_close(out, want)
    assert all(x.grad is not None and x.grad.isfinite().all() for x in leaves)
    assert (leaves[0].grad == 0).all()
    assert (leaves[1].grad == 0).all()
    assert (leaves[3].grad != 0).any()


@pytest.mark.parametrize("over", ["channel", "pixel"])
@pytest.mark.parametrize(("fg", "bg"), [(1.0, 1.6), (2.5, 1.0), (2.5, 1.6)])
def test_scales_multiply_the_sigmas_in_value_and_gradient(over: str, fg: float, bg: float) -> None:
    found = []
    for likelihood, scales in (
        (MixtureLikelihood(0.4, 0.2, over), (torch.tensor(fg), torch.tensor(bg))),  # type: ignore[arg-type]
        (MixtureLikelihood(0.4 * fg, 0.2 * bg, over), ()),  # type: ignore[arg-type]
    ):
        leaves = [x.clone().requires_grad_() for x in case()]
        out = likelihood(*leaves, *scales)
        found.append([out, *torch.autograd.grad(out.sum(), leaves)])
    for scaled, wide in zip(*found, strict=True):
        torch.testing.assert_close(scaled, wide, rtol=1e-6, atol=1e-6)


def test_the_one_sigma_of_a_gaussian_is_that_of_the_objects() -> None:
    scales = torch.tensor(2.0), torch.tensor(3.0)
    torch.testing.assert_close(GaussianLikelihood(0.1)(*case(), *scales), GaussianLikelihood(0.2)(*case()))


@pytest.mark.parametrize(
    "likelihood", [MixtureLikelihood(), MixtureLikelihood(0.1, 0.04, "pixel"), GaussianLikelihood()]
)
def test_no_gradient_goes_to_the_scales(likelihood: Likelihood) -> None:
    means = case()[2].requires_grad_()
    inputs = [*case()[:2], means, *case()[3:]]
    scales = [torch.tensor(2.0, requires_grad=True), torch.tensor(3.0, requires_grad=True)]
    likelihood(*inputs, *scales).sum().backward()
    assert means.grad is not None
    assert all(scale.grad is None for scale in scales)


def whole_case(dtype: torch.dtype = torch.float64, seen: int = 1) -> tuple[torch.Tensor, ...]:
    """`case` with the background as the last component, as `responsibilities` takes it."""
    image, log_objects, means, log_background, background = case(dtype, seen)
    masks = torch.cat([log_objects, log_background[:, None]], 1).exp()
    return image, masks, torch.cat([means, background[:, :1]], 1), torch.arange(4) == 3


def shadows(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """What components are as likely like in `case` with two images of the background; objects like their means."""
    _, _, means, _, background = case(dtype, 2)
    return torch.cat([means, background[:, 1:]], 1)


@pytest.mark.parametrize("seen", [1, 2])
@pytest.mark.parametrize("over", ["channel", "pixel"])
def test_responsibilities_against_bayes_rule_pixel_by_pixel(over: str, seen: int) -> None:
    image, masks, means, background = whole_case(seen=seen)
    likelihood = MixtureLikelihood(0.4, 0.2, over)  # type: ignore[arg-type]
    looks = [means] if seen == 1 else [means, shadows()]
    got = likelihood.responsibilities(image, masks, means, background, shadowed=None if seen == 1 else looks[1])
    for n in range(2):
        for y in range(4):
            for x in range(5):
                p = [
                    [
                        [
                            density(image[n, c, y, x].item(), look[n, k, c, y, x].item(), 0.2 if k == 3 else 0.4)
                            for c in range(3)
                        ]
                        for look in looks
                    ]
                    for k in range(4)
                ]
                m = masks[n, :, y, x].tolist()
                if over == "pixel":
                    joint = [m[k] * sum(math.prod(one) for one in p[k]) / seen for k in range(4)]
                    want = [one / sum(joint) for one in joint]
                else:
                    mean = [[sum(one[c] for one in p[k]) / seen for c in range(3)] for k in range(4)]
                    evidence = [sum(m[k] * mean[k][c] for k in range(4)) for c in range(3)]
                    want = [sum(m[k] * mean[k][c] / evidence[c] for c in range(3)) / 3 for k in range(4)]
                assert got[n, :, y, x].tolist() == pytest.approx(want, rel=1e-9, abs=1e-300)
    assert (got[:, 1] == 0).all()  # an absent component's


@pytest.mark.parametrize("seen", [1, 2])
@pytest.mark.parametrize(("over", "values"), [("channel", 3), ("pixel", 1)])
@pytest.mark.parametrize("scales", [(), (torch.tensor(2.5), torch.tensor(0.75))])
def test_responsibilities_are_what_the_likelihood_gains_by_a_larger_mask(
    over: str, values: int, scales: tuple[torch.Tensor, ...], seen: int
) -> None:
    image, log_objects, means, log_background, background = case(seen=seen)
    leaves = [log_objects.requires_grad_(), log_background.requires_grad_()]
    likelihood = MixtureLikelihood(0.3, 0.1, over)  # type: ignore[arg-type]
    out = likelihood(image, leaves[0], means, leaves[1], background, *scales).sum()
    objects, back = torch.autograd.grad(out, leaves)
    gains = torch.cat([objects, back[:, None]], 1) / values
    found = likelihood.responsibilities(*whole_case(seen=seen), *scales, shadowed=None if seen == 1 else shadows())
    torch.testing.assert_close(found, gains)


@pytest.mark.parametrize("shadowed", [None, shadows(torch.float32)], ids=["no shadows", "shadows"])
def test_responsibilities_far_from_every_mean_still_sum_to_one(shadowed: torch.Tensor | None) -> None:
    image, masks, means, background = whole_case(torch.float32)
    for likelihood in (MixtureLikelihood(), MixtureLikelihood(0.1, 0.04, "pixel")):
        found = likelihood.responsibilities(image + 50, masks, means, background, shadowed=shadowed)
        torch.testing.assert_close(found.sum(1), torch.ones(2, 4, 5))


@pytest.mark.parametrize("look", [True, False])
def test_a_mixture_may_turn_from_channels_to_whole_colours(look: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not look:  # as on a GPU, where both are computed
        monkeypatch.setattr("apex_lab.models.apex.likelihood.may_look", lambda _: False)
    channel, pixel = (MixtureLikelihood(0.4, 0.2, over) for over in ("channel", "pixel"))  # type: ignore[arg-type]
    for share in (0.0, 0.25, 1.0):
        whole = torch.tensor(share)
        want = (1 - share) * channel(*case()) + share * pixel(*case())
        torch.testing.assert_close(channel(*case(), whole=whole), want)
        torch.testing.assert_close(pixel(*case(), whole=whole), want)
        masks = [likelihood.responsibilities(*whole_case()) for likelihood in (channel, pixel)]
        got = channel.responsibilities(*whole_case(), whole=whole)
        torch.testing.assert_close(got, (1 - share) * masks[0] + share * masks[1])


@pytest.mark.parametrize("over", ["channel", "pixel"])
@pytest.mark.parametrize("images", [1, 2])
def test_the_gradient_by_hand_equals_autograd_however_colours_are_mixed(over: str, images: int) -> None:
    image, log_objects, means, log_background, background = case()
    several = torch.cat([background, 0.5 * background], dim=1)[:, :images]
    likelihood = MixtureLikelihood(0.4, 0.2, over)  # type: ignore[arg-type]
    leaves = [x.clone().requires_grad_() for x in (image, log_objects, means, log_background, several)]
    found = torch.autograd.grad(likelihood(*leaves).sum(), leaves)
    x, m, mu, back, pictures = leaves
    by_object = log_normal(x[:, None], mu, 0.4)
    by_background = log_normal(x[:, None], pictures, 0.2)
    if over == "pixel":
        by_object, by_background = by_object.sum(2, keepdim=True), by_background.sum(2, keepdim=True)
    parts = [by_object + m[:, :, None], by_background + back[:, None, None] - torch.tensor(float(images)).log()]
    out = torch.logsumexp(torch.cat(parts, dim=1), dim=1).sum()
    for got, want in zip(found, torch.autograd.grad(out, leaves), strict=True):
        torch.testing.assert_close(got, want.nan_to_num())

"""The whole model on tiny videos: shapes, independence, identities, gradients, reproducibility, tracking."""

import math

import pytest
import torch

from apex_lab.models.apex import (
    Apex,
    ApexNormalisation,
    Background,
    GaussianLikelihood,
    ImageGlimpses,
    MixtureLikelihood,
    ScalorNormalisation,
)
from apex_lab.models.apex.background import shadowed
from apex_lab.models.apex.objects import Objects
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.scene import Context, Scene, Statistics, schedule_at
from tests.models.apex.small import CONTEXT, SCHEDULE, parts, tiny, video


def check_scene(scene: Scene, b: int, t: int, slots: int) -> None:
    k = slots + 1
    assert scene.masks.shape == (b, t, k, 32, 32)
    assert (scene.masks >= 0).all()
    assert (scene.masks.sum(2) - 1).abs().max() <= 1e-6
    assert scene.background.tolist() == [False] * slots + [True]
    assert scene.ids.shape == scene.presence.shape == (b, t, k)
    assert ((scene.ids == -1) == (scene.presence == 0)).all()
    assert (scene.masks[scene.ids == -1] == 0).all()
    assert scene.reconstruction.shape == (b, t, 3, 32, 32)
    assert all(v.shape == (b,) and v.isfinite().all() for v in scene.terms.values())
    for i in range(b):
        for j in range(t):
            ids = [x for x in scene.ids[i, j].tolist() if x != -1]
            assert len(ids) == len(set(ids))


@pytest.mark.parametrize("training", [True, False])
def test_scene_keeps_the_contract(training: bool) -> None:
    model = tiny().train(training)
    scene = model(video(), CONTEXT)
    check_scene(scene, 3, 4, 3)
    assert set(scene.terms) == set(model.term_names)
    assert (scene.ids[:, :, :3] >= 0).any()


def test_an_identity_never_comes_back() -> None:
    model = tiny().train()
    reappeared = vanished = 0
    for seed in range(10):
        torch.manual_seed(seed)
        ids = model(video(3, 6), CONTEXT).ids[..., :3]
        for b in range(3):
            frames = [set(ids[b, t].tolist()) - {-1} for t in range(6)]
            for identity in set().union(*frames):
                seen = [identity in f for f in frames]
                first, last = seen.index(True), 5 - seen[::-1].index(True)
                vanished += last < 5
                reappeared += not all(seen[first : last + 1])
    assert reappeared == 0
    assert vanished > 0


def test_a_video_does_not_depend_on_the_rest_of_its_batch() -> None:
    model = tiny().eval()
    x = video()
    together = model(x, CONTEXT)
    for i in range(3):
        alone = model(x[i : i + 1], CONTEXT)
        torch.testing.assert_close(alone.masks[0], together.masks[i], rtol=1e-4, atol=1e-5)
        assert torch.equal(alone.ids[0], together.ids[i])
        for name in alone.terms:
            torch.testing.assert_close(alone.terms[name][0], together.terms[name][i], rtol=1e-4, atol=1e-2)


def test_no_video_influences_the_gradient_of_another() -> None:
    model = tiny().eval()
    x = video().requires_grad_()
    model(x, CONTEXT).terms["nll"][0].backward()
    assert x.grad is not None
    assert x.grad[0].abs().sum() > 0
    assert (x.grad[1:] == 0).all()


def test_the_future_does_not_change_the_past() -> None:
    model = tiny().eval()
    x = video()
    y = x.clone()
    y[:, 3] = 1 - y[:, 3]
    a, b = model(x, CONTEXT), model(y, CONTEXT)
    torch.testing.assert_close(a.masks[:, :3], b.masks[:, :3], rtol=1e-4, atol=1e-5)


def test_permuting_components_permutes_masks_and_leaves_the_likelihood() -> None:
    torch.manual_seed(3)
    order = torch.tensor([2, 0, 3, 1])
    alpha, presence = 3 * torch.randn(2, 4, 8, 8), torch.rand(2, 4)
    windows = torch.cat([0.2 + 0.5 * torch.rand(2, 4, 2), torch.rand(2, 4, 2) - 0.5], -1)
    valid = torch.tensor([[True, True, False, True]] * 2)
    means, image, back = torch.rand(2, 4, 3, 16, 16), torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    for masks in (ApexNormalisation(), ScalorNormalisation()):
        a = masks.compose(alpha, presence, valid, Paster(windows, 8, 16))
        b = masks.compose(alpha[:, order], presence[:, order], valid[:, order], Paster(windows[:, order], 8, 16))
        torch.testing.assert_close(a.objects[:, order], b.objects)
        torch.testing.assert_close(a.background, b.background)
        for likelihood in (MixtureLikelihood(), GaussianLikelihood()):
            first = likelihood(image, a.log_objects, means, a.log_background, back[:, None])
            second = likelihood(image, b.log_objects, means[:, order], b.log_background, back[:, None])
            torch.testing.assert_close(first, second)


def test_permuting_slots_permutes_propagation() -> None:
    model = tiny().eval()
    torch.manual_seed(4)
    order = torch.tensor([2, 0, 1])
    state = Objects(
        torch.randn(1, 3, 6), torch.rand(1, 3, 4) - 0.5, torch.rand(1, 3), *(torch.randn(1, 3, 12) for _ in range(4))
    )
    e = torch.randn(1, 8, 8, 8)
    valid = torch.tensor([[True, True, False]])

    def propagate(state: Objects, valid: torch.Tensor) -> Objects:
        t = SCHEDULE["temperature"]
        return model.propagation(state, model.glimpses, model.appearance, e, e, valid, t, None)[0]

    a, b = propagate(state, valid), propagate(Objects(*(x[:, order] for x in state)), valid[:, order])
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x[:, order], y)


def test_gradients_reach_every_parameter() -> None:
    model = tiny().train()
    torch.manual_seed(5)
    sum(model(video(), CONTEXT).terms.values()).sum().backward()
    missing = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert missing == []
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("logit", [-30.0, 30.0])
@pytest.mark.parametrize("size", [-30.0, 30.0])
def test_gradients_stay_finite_with_all_or_no_objects_and_extreme_windows(logit: float, size: float) -> None:
    model = tiny().train()
    with torch.no_grad():
        model.discovery.head_pres[-1].weight.zero_()
        model.discovery.head_pres[-1].bias.fill_(logit)
        model.discovery.head_where.bias[:2] = size
    scene = model(video(), CONTEXT)
    assert (scene.ids[:, 0, :3] >= 0).all() if logit > 0 else (scene.ids[:, :, :3] == -1).all()
    sum(scene.terms.values()).sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_the_same_seed_gives_the_same_losses() -> None:
    def losses() -> list[float]:
        model = tiny().train()
        optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
        values = []
        for step in range(4):
            torch.manual_seed(step)
            loss = sum(model(video(), CONTEXT).terms.values()).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            values.append(loss.item())
        return values

    first = losses()
    assert first == losses()
    assert len(set(first)) == 4


def test_z_what_zero_gives_discovery_and_propagation_the_same_appearance() -> None:
    """Discovery infers z_what with the same networks as propagation, from z_what_0 = 0."""
    model = tiny().eval()
    e = torch.randn(1, 8, 8, 8)
    proposals = model.discovery(e, e, model.glimpses, model.appearance, None)
    code = model.glimpses.look(e, window_of(proposals.place)).flatten(0, 1)
    q, _ = model.appearance(code, torch.zeros(16, 6), torch.zeros(16, 12))
    torch.testing.assert_close(proposals.q_what.mean[0], q.mean)
    assert isinstance(q, Gaussian)


@pytest.mark.parametrize(
    "part",
    [
        {"glimpses": ImageGlimpses(4, 6)},
        {"masks": ScalorNormalisation()},
        {"likelihood": GaussianLikelihood(), "masks": ScalorNormalisation()},
        {"render_top": None},
        {"background": Background(32, 6, 6, "none")},
        {"kl": "exclusive"},
        {"merges": 2, "background": Background(32, 6, 6, shadow=0.7)},
        {"merges": 1, "likelihood": GaussianLikelihood(), "masks": ScalorNormalisation(), "start_size": 0.5},
    ],
)
def test_every_variant_trains_a_step(part: dict) -> None:
    model = tiny(**part).train()
    scene = model(video(), CONTEXT)
    check_scene(scene, 3, 4, 3)
    sum(scene.terms.values()).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_the_background_starts_at_the_median() -> None:
    median = torch.rand(3, 32, 32) * 0.9 + 0.05
    model = tiny()
    model.initialise(Statistics(lambda: median))
    picture = model.background.decode(torch.zeros(1, 6))[0]
    assert (picture - median).abs().max() < 0.06
    plain = tiny(background=Background(32, 6, 6, "none"))
    plain.initialise(Statistics(lambda: median))
    assert plain.background.bias_image is None


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"model\.image_size=48"):
        Apex(48, **parts())
    with pytest.raises(ValueError, match="built for 32 px"):
        tiny()(torch.rand(1, 2, 3, 64, 64), CONTEXT)


@pytest.mark.parametrize(("fg", "bg"), [(1.0, 1.6), (2.5, 1.0)])
def test_the_scales_of_the_sigmas_widen_those_of_the_whole_model(fg: float, bg: float) -> None:
    def terms(sigma_fg: float, sigma_bg: float, **scales: float) -> dict[str, torch.Tensor]:
        model = tiny(likelihood=MixtureLikelihood(sigma_fg, sigma_bg)).eval()
        return model(video(), Context({**SCHEDULE, **schedule_at(scales)})).terms

    scaled = terms(0.1, 0.05, sigma_fg_scale=fg, sigma_bg_scale=bg)
    wide, narrow = terms(0.1 * fg, 0.05 * bg), terms(0.1, 0.05)
    for name, value in wide.items():
        torch.testing.assert_close(scaled[name], value, rtol=1e-5, atol=1e-3)
    assert not torch.allclose(scaled["nll"], narrow["nll"])


def test_the_posterior_is_bayes_rule_on_what_the_scene_shows() -> None:
    model = tiny().eval()
    scene = model(video(), CONTEXT)
    found = model.posterior(scene, video(), Context({**SCHEDULE, "sigma_bg_scale": torch.tensor(2.0)}))
    assert model.has_posterior
    assert scene.means is not None
    sigma = torch.where(scene.background, 0.08, 0.1)[:, None, None, None]
    density = torch.distributions.Normal(scene.means, sigma).log_prob(video()[:, :, None]).double().exp()
    joint = scene.masks[:, :, :, None].double() * density
    torch.testing.assert_close(found.double(), (joint / joint.sum(2, keepdim=True)).mean(3), atol=1e-5, rtol=1e-4)
    assert (found[scene.masks == 0] == 0).all()
    assert not torch.allclose(found, scene.masks, atol=0.01)


def test_the_posterior_knows_cast_shadows() -> None:
    model = tiny(background=Background(32, 6, 6, shadow=0.6)).eval()
    scene = model(video(), CONTEXT)
    found = model.posterior(scene, video(), CONTEXT)
    torch.testing.assert_close(found.sum(2), torch.ones(3, 4, 32, 32))
    assert scene.means is not None
    dark = scene.means.clone()
    dark[:, :, -1] = shadowed(dark[:, :, -1], video(), 0.6)
    sigma = torch.where(scene.background, 0.04, 0.1)[:, None, None, None]
    seen = video()[:, :, None]
    looks = [torch.distributions.Normal(x, sigma).log_prob(seen).double().exp() for x in (scene.means, dark)]
    joint = scene.masks[:, :, :, None].double() * (looks[0] + looks[1]) / 2
    torch.testing.assert_close(found.double(), (joint / joint.sum(2, keepdim=True)).mean(3), atol=1e-5, rtol=1e-4)
    plain = model.likelihood.responsibilities(  # type: ignore[attr-defined]
        video().flatten(0, 1), scene.masks.flatten(0, 1), scene.means.flatten(0, 1), scene.background
    )
    assert not torch.allclose(found.flatten(0, 1), plain, atol=0.01)


def test_without_objects_cast_shadows_are_all_that_is_added_to_the_background() -> None:
    model = tiny(start_presence=0.01, background=Background(32, 6, 6, shadow=0.6)).eval()
    scene = model(video(), CONTEXT)
    assert (scene.presence[:, :, :-1] == 0).all()
    assert scene.means is not None
    lit = scene.means[:, :, -1]
    dark = shadowed(lit, video(), 0.6)
    torch.testing.assert_close(scene.reconstruction, dark)
    assert not torch.equal(dark, lit)
    looks = [torch.distributions.Normal(x, 0.04).log_prob(video()) for x in (lit, dark)]
    want = -(torch.logaddexp(*looks) - math.log(2)).sum((1, 2, 3, 4))
    torch.testing.assert_close(scene.terms["nll"], want)


def test_a_posterior_is_refused_without_detail_and_under_one_gaussian() -> None:
    model = tiny().eval()
    scene = model(video(), Context(SCHEDULE))
    assert scene.means is None
    with pytest.raises(ValueError, match=r"no means: give Context\(detail=True\)"):
        model.posterior(scene, video(), CONTEXT)
    model = tiny(likelihood=GaussianLikelihood()).eval()
    assert not model.has_posterior
    with pytest.raises(TypeError, match="Apex has no mixture likelihood"):
        model.posterior(model(video(), CONTEXT), video(), CONTEXT)

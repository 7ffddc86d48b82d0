"""The objective given the latents, in training mode: samples, relaxed presences, both directions of the KL."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex import Apex, ApexNormalisation, MixtureLikelihood
from apex_lab.models.apex.rollout import Memory, State
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import schedule_at
from tests.models.apex import naive
from tests.models.apex.small import CONTEXT, SIZE, Inside, lively, video

P0 = 0.1
OPEN = schedule_at(
    {
        "temperature": 0.7,
        "discovery_presence": P0,
        "carry": 1.0,
        "discover": 1.0,
        "sigma_fg_scale": 1.25,
        "sigma_bg_scale": 0.75,
    }
)


def trained(model: Apex, seed: int = 0) -> Inside:
    """What a training step of the model sees, without gradients."""
    torch.manual_seed(seed)
    with torch.no_grad():
        return Inside(model.double().train(), video(2, 4).double(), OPEN)


def window(place: Tensor) -> Tensor:
    return torch.cat([1 / (1 + (-place[:2]).exp()), place[2:]])


def pair(d: Gaussian, *index: int) -> tuple[Tensor, Tensor]:
    return d.mean[index], d.std[index]


def kl(q: tuple[Tensor, Tensor], p: tuple[Tensor, Tensor], direction: str) -> float:
    return naive.kl_normal(p, q) if direction == "inclusive" else naive.kl_normal(q, p)


@pytest.mark.parametrize("direction", ["inclusive", "exclusive"])
def test_every_kl_divergence(direction: str) -> None:
    seen = trained(lively(kl=direction))
    steps, found = seen.steps, seen.proposals
    logit = math.log((1 / 6) / (1 - 1 / 6))
    centre = torch.tensor([logit, logit, 0.0, 0.0], dtype=torch.float64)
    for b in range(2):
        want = dict.fromkeys(("kl_what", "kl_where", "kl_pres"), 0.0)
        for t in range(4):
            beliefs = steps.propagated
            for k in range(3):
                if not steps.alive[b, t, k]:
                    continue
                z_pres = float(steps.presence[b, t, k])
                assert 0 < z_pres < 1
                index = (b, t, k)
                want["kl_what"] += z_pres * kl(pair(beliefs.q_what, *index), pair(beliefs.p_what, *index), direction)
                want["kl_where"] += z_pres * kl(pair(beliefs.q_where, *index), pair(beliefs.p_where, *index), direction)
                want["kl_pres"] += naive.kl_presence(float(beliefs.q_pres[index]), float(beliefs.p_pres[index]))
            for k in range(16):
                index = (b, t, k)
                z_pres = float(steps.discovery_pres[index])
                q_what, q_where = pair(found.q_what, *index), pair(found.q_where, *index)
                want["kl_what"] += z_pres * kl(q_what, (torch.zeros(6), torch.ones(6)), direction)
                want["kl_where"] += z_pres * kl(q_where, (centre, torch.ones(4)), direction)
                want["kl_pres"] += naive.kl_presence(
                    float(steps.discovery_prob[index]), float(steps.discovery_prior[index])
                )
        for name, value in want.items():
            assert float(seen.scene.terms[name][b]) == pytest.approx(value, rel=1e-9), name


def test_the_kl_of_the_background_is_between_its_posterior_and_what_the_frame_before_leads_to_expect() -> None:
    model = lively()
    seen = trained(model)
    steps = seen.steps
    assert isinstance(model.masks, ApexNormalisation)
    for b in range(2):
        want = 0.0
        for t in range(4):
            *_, m_bg = naive.frame_masks(*rendered(seen, b, t), model.masks.c, SIZE)
            x = torch.cat([m_bg[None], video(2, 4)[b, t].double()])
            with torch.no_grad():
                q = naive.normal(model.background.encoder(x[None])[0])
                p = naive.normal(model.background.transition(seen.z_background[b, t - 1][None])[0])
            want += naive.kl_normal(q, (torch.zeros(6), torch.ones(6)) if t == 0 else p)  # KL(q || p)
        assert float(seen.scene.terms["kl_background"][b]) == pytest.approx(want, rel=1e-9)
    assert steps.alive[:, 1:].any()


def rendered(seen: Inside, b: int, t: int) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Mask logits, presences and windows of the components that explain a frame."""
    steps = seen.steps
    there = [k for k in range(steps.valid.shape[2]) if steps.valid[b, t, k]]
    return (
        [steps.alpha[b, t, k] for k in there],
        [steps.presence[b, t, k] for k in there],
        [window(steps.place[b, t, k]) for k in there],
    )


def test_likelihood_and_mask_entropy() -> None:
    model = lively()
    seen = trained(model)
    steps = seen.steps
    assert isinstance(model.likelihood, MixtureLikelihood)
    assert isinstance(model.masks, ApexNormalisation)
    image = video(2, 4).double()
    for b in range(2):
        nll = entropy = 0.0
        for t in range(4):
            alphas, presences, windows = rendered(seen, b, t)
            masks, m_fg, m_bg = naive.frame_masks(alphas, presences, windows, model.masks.c, SIZE)
            there = [k for k in range(7) if steps.valid[b, t, k]]
            with torch.no_grad():
                for k, alpha in zip(there, alphas, strict=True):
                    torch.testing.assert_close(alpha, naive.mask_logits(model, steps.what[b, t, k]))  # Eq. 7
                colours = [torch.sigmoid(model.colour_decoder(steps.what[b, t, k][None])[0]) for k in there]
                backdrop = model.background.decode(seen.z_background[b, t][None])[0]
            means = [naive.paste(colour, w, SIZE) for colour, w in zip(colours, windows, strict=True)]
            nll -= naive.log_likelihood(image[b, t], [*masks, m_bg], means, [backdrop], model.likelihood, (1.25, 0.75))
            entropy += naive.entropy(masks, m_fg)
        assert float(seen.scene.terms["nll"][b]) == pytest.approx(nll, rel=1e-9)
        assert float(seen.scene.terms["mask_entropy"][b]) == pytest.approx(entropy, rel=1e-9)


def test_presence_of_discoveries_is_what_propagation_left_open() -> None:
    """Eq. 17, 18 and the prior of Eq. 6, with propagated objects that are present by halves."""
    seen = trained(lively())
    steps, found = seen.steps, seen.proposals
    assert bool((steps.discovery_prob[:, 1:] < 0.5 * found.prob[:, 1:]).any())
    model = lively().double()
    for b in range(2):
        for t in (0, 2):
            s = torch.zeros(SIZE, SIZE, dtype=torch.float64)
            for k in range(3):
                if steps.alive[b, t, k]:
                    weight = torch.log(1 + steps.alpha[b, t, k].exp()) * steps.presence[b, t, k]
                    s = s + naive.paste(weight[None], window(steps.place[b, t, k]), SIZE)[0]
            scope = 1 - torch.tanh(s)
            for d in range(16):
                with torch.no_grad():
                    alpha = naive.mask_logits(model, found.what[b, t, d])
                place = window(found.place[b, t, d])
                inside = naive.paste(torch.ones_like(alpha)[None], place, SIZE)[0]
                claim = torch.tanh(torch.log(1 + naive.paste(alpha[None], place, SIZE)[0].exp())) * inside
                context = float((scope * claim).sum() / claim.sum())
                if t == 0:
                    assert steps.discovery_prob[b, t, d] == found.prob[b, t, d]  # exactly: p_context is 1
                assert float(steps.discovery_prob[b, t, d]) == pytest.approx(float(found.prob[b, t, d]) * context)
                share = float((scope * inside).sum() / inside.sum())
                assert float(steps.discovery_prior[b, t, d]) == pytest.approx(P0 * share, rel=1e-6)


def test_the_terms_in_float32_are_those_in_float64() -> None:
    """The same latents and weights, and no new noise, through `_explain` in both precisions."""
    model = lively()
    seen = trained(model)

    def no_state(z_background: Tensor) -> State:
        empty = Memory.empty(2, 3, 6, 12, z_background)
        return State((z_background, z_background), z_background, empty, z_background)

    def in_float32(x: object) -> object:
        if isinstance(x, Tensor):
            return x.float() if x.is_floating_point() else x
        assert isinstance(x, tuple)
        return type(x)(*(in_float32(y) for y in x))

    with torch.no_grad():
        exact = model._explain(video(2, 4).double(), seen.proposals, seen.steps, CONTEXT, None, no_state, None)
        found, steps = in_float32(seen.proposals), in_float32(seen.steps)
        rounded = model.float()._explain(video(2, 4), found, steps, CONTEXT, None, no_state, None)  # type: ignore[arg-type]
    for name, value in exact.terms.items():
        torch.testing.assert_close(rounded.terms[name].double(), value, rtol=1e-4, atol=1e-3)
    assert (rounded.masks - exact.masks).abs().max() < 1e-5

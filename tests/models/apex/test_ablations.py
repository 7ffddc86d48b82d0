"""Every ablation swaps exactly its part: in the configuration, in the weights, and in what the model says."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from apex_lab.config.building import build_model, build_optimizer, build_schedules, build_weights
from apex_lab.config.schema import Config
from apex_lab.models.apex import Apex, FeatureGlimpses, GaussianLikelihood, ImageGlimpses
from apex_lab.scene import Scene
from apex_lab.training.update import WeightUpdate, named_parameters, remember_rates
from tests.conftest import REPOSITORY, compose_job
from tests.models.apex import naive
from tests.models.apex.small import SIZE, Inside, resolved, video

LIKELIHOOD = {f"model.likelihood.{key}" for key in ("_target_", "sigma_fg", "sigma_bg", "mixture_over", "sigma")}
MASKS = {f"model.masks.{key}" for key in ("_target_", "c", "outside")}
SWAPS = {
    "image_stn": {"model.glimpses._target_"},
    "no_entropy": {"loss.mask_entropy"},
    "scalor_norm": MASKS,
    "gaussian": LIKELIHOOD,
    "gaussian_scalor_norm": LIKELIHOOD | MASKS,
}
SMOKE = ("model=apex", "data=p2d", "scale=smoke", "model.start_presence=0.9")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def flat(tree: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Nested mappings as `a.b.c` -> value."""
    rows: dict[str, Any] = {}
    for key, value in tree.items():
        here = f"{path}{key}"
        rows |= flat(value, f"{here}.") if isinstance(value, Mapping) else {here: value}
    return rows


@functools.cache
def checked(name: str | None) -> Config:
    """The checked configuration of an ablation, or of the base, at its smallest."""
    return compose_job(*SMOKE, *(() if name is None else (f"+ablation={name}",))).config


def built(name: str | None = None) -> Apex:
    """The model of an ablation, or the base, as its configuration makes it from the seed."""
    model = build_model(checked(name))
    assert isinstance(model, Apex)
    return model


def seen(model: Apex, frames: int = 3, training: bool = True) -> Inside:
    torch.manual_seed(7)
    with torch.no_grad():
        return Inside(model.train(training), video(2, frames))


def same_scene(a: Scene, b: Scene, terms: set[str]) -> None:
    """Bit for bit the same, but for the loss terms that are not named."""
    for name in ("masks", "ids", "presence", "appearance", "reconstruction"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert a.windows is not None
    assert b.windows is not None
    torch.testing.assert_close(a.windows, b.windows, rtol=0, atol=0, equal_nan=True)
    assert {name for name in a.terms if torch.equal(a.terms[name], b.terms[name])} == terms


ALL_TERMS = set(Apex.term_names)


def test_all_ablations_are_here() -> None:
    assert {path.stem for path in (REPOSITORY / "conf" / "ablation").glob("*.yaml")} == SWAPS.keys()


@pytest.mark.parametrize("name", SWAPS)
@pytest.mark.parametrize("scale", ["smoke", "cpu", "paper"])
def test_the_configuration_differs_in_the_swapped_part_only(name: str, scale: str) -> None:
    words = ("model=apex", "data=p2d", f"scale={scale}")
    base, other = flat(resolved(*words)), flat(resolved(*words, f"+ablation={name}"))
    absent = object()
    differ = {key for key in base.keys() | other.keys() if base.get(key, absent) != other.get(key, absent)}
    assert differ == SWAPS[name]


@pytest.mark.parametrize("name", SWAPS)
def test_all_other_weights_are_the_same_from_the_same_seed(name: str) -> None:
    base, other = built().state_dict(), built(name).state_dict()
    elsewhere = [key for key in base if name != "image_stn" or not key.startswith("glimpses.")]
    assert [key for key in other if key in set(elsewhere)] == elsewhere
    for key in elsewhere:
        assert torch.equal(base[key], other[key]), key
    swapped = other.keys() ^ set(elsewhere)
    assert all(key.startswith("glimpses.") for key in swapped)
    assert bool(swapped) == (name == "image_stn")


@pytest.mark.parametrize("name", SWAPS)
def test_it_trains(name: str) -> None:
    config, model = checked(name), built(name)
    schedules, weights = build_schedules(config), build_weights(config)
    update = WeightUpdate(model.train(), schedules, weights, step=10_000)
    optimizer = remember_rates(build_optimizer(config, named_parameters(model)))
    before = {key: value.clone() for key, value in model.named_parameters()}
    for _ in range(2):
        update((255 * video(2, 3)).byte(), optimizer)
        assert update.latest["train/loss"].isfinite()
    assert [key for key, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []
    assert [key for key, p in model.named_parameters() if torch.equal(p, before[key])] == []


def test_no_entropy_takes_the_entropy_out_of_the_loss_and_nothing_else() -> None:
    base, other = seen(built()), seen(built("no_entropy"))
    same_scene(base.scene, other.scene, ALL_TERMS)
    losses = [
        WeightUpdate(built(), {}, build_weights(checked(name))).objective(base.scene.terms)
        for name in (None, "no_entropy")
    ]
    entropy = base.scene.terms["mask_entropy"].mean()
    assert entropy > 1
    torch.testing.assert_close(losses[0] - losses[1], entropy, rtol=1e-3, atol=0.1)
    weighed = [term for name, term in base.scene.terms.items() if name not in Apex.optional_terms]
    torch.testing.assert_close(losses[0], torch.stack(weighed).sum(0).mean())


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("name", "counterpart"), [("gaussian", None), ("gaussian_scalor_norm", "scalor_norm")])
def test_gaussian_changes_the_likelihood_only(name: str, counterpart: str | None, training: bool) -> None:
    model = built(name)
    base, other = seen(built(counterpart), training=training), seen(model, training=training)
    same_scene(base.scene, other.scene, ALL_TERMS - {"nll"})
    assert isinstance(model.likelihood, GaussianLikelihood)
    assert model.likelihood.sigma == 0.1  # the mixture's sigma_fg
    blend = other.scene.reconstruction.double()
    want = -torch.distributions.Normal(blend, 0.1).log_prob(video(2, 3).double()).sum((1, 2, 3, 4))
    torch.testing.assert_close(other.scene.terms["nll"].double(), want, rtol=1e-5, atol=0)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("name", "counterpart"), [("scalor_norm", None), ("gaussian_scalor_norm", "gaussian")])
def test_scalor_norm_changes_the_masks_only(name: str, counterpart: str | None, training: bool) -> None:
    """In a first frame nothing depends on masks but the picture and the background."""
    base, other = seen(built(counterpart), 1, training), seen(built(name), 1, training)
    for field in ("what", "place", "presence", "valid", "discovery_prob", "discovery_prior", "discovery_pres", "ids"):
        assert torch.equal(getattr(base.steps, field), getattr(other.steps, field)), field
    assert {term for term in ALL_TERMS if torch.equal(base.scene.terms[term], other.scene.terms[term])} == {
        "kl_what",
        "kl_where",
        "kl_pres",
    }
    assert torch.equal(base.scene.presence, other.scene.presence)
    assert torch.equal(base.scene.appearance, other.scene.appearance)
    assert not torch.equal(base.scene.masks, other.scene.masks)
    assert base.steps.valid.any()


def test_scalor_norm_s_masks_by_the_paper_s_formula() -> None:
    """alpha^2 / sum(alpha) of the warped, presence-weighted sigmoid masks, in a whole roll-out."""
    model = built("scalor_norm")
    run = seen(model, training=False)
    steps = run.steps
    for b in range(2):
        for t in range(3):
            there = [k for k in range(steps.valid.shape[2]) if steps.valid[b, t, k]]
            warped = []
            for k in there:
                place = steps.place[b, t, k].double()
                window = torch.cat([torch.sigmoid(place[:2]), place[2:]])
                with torch.no_grad():
                    alpha = torch.sigmoid(model.mask_decoder(steps.what[b, t, k][None])[0]).double()
                warped.append(naive.paste(alpha * steps.presence[b, t, k], window, SIZE)[0])
            total = sum(warped, torch.zeros(SIZE, SIZE).double())
            for slot, source in enumerate(steps.source[b, t].tolist()):
                if steps.carried[b, t, slot]:
                    own = warped[there.index(source)]
                    want = torch.where(total > 0, own**2 / total.clamp_min(1e-6), 0.0)
                    torch.testing.assert_close(run.scene.masks[b, t, slot].double(), want, rtol=0, atol=1e-5)
    assert steps.carried.any()


def test_image_stn_changes_where_glimpses_come_from_and_their_networks_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Features and discovered windows agree; with equal codes for all glimpses everything does, to the last bit."""
    base, other = built(), built("image_stn")
    assert isinstance(base.glimpses, FeatureGlimpses)
    assert isinstance(other.glimpses, ImageGlimpses)
    first, second = seen(base, training=False), seen(other, training=False)
    assert torch.equal(first.proposals.q_where.mean, second.proposals.q_where.mean)
    assert torch.equal(first.proposals.place, second.proposals.place)
    assert not torch.equal(first.proposals.what, second.proposals.what)

    def code(self: object, encoder: object, source: Tensor, window: Tensor) -> Tensor:
        return torch.sin(100 * window).repeat(1, 1, base.hidden // 4)

    for kind in (FeatureGlimpses, ImageGlimpses):
        monkeypatch.setattr(kind, "_encode", code)
    same_scene(seen(base).scene, seen(other).scene, ALL_TERMS)


def test_image_stn_cuts_glimpses_from_the_frame_and_crops_from_two_frames() -> None:
    model, x = built("image_stn"), video(1, 3)
    look_at, follow_in = model.glimpses.sources(x, torch.zeros(1, 3, 8, 8, 8))
    window = torch.tensor([0.4, 0.3, 0.1, -0.2])
    cuts: list[Tensor] = []
    for encoder in (model.glimpses.glimpse, model.glimpses.propagation):
        encoder.register_forward_pre_hook(lambda module, inputs: cuts.append(inputs[0]))
    model.glimpses.look(look_at[:, 2], window[None, None])
    model.glimpses.follow(follow_in[:, 2], window[None, None])
    size = 2 * 4  # twice the size of a crop of the feature map
    this, before = (naive.cut(x[0, t] - 0.5, window, size) for t in (2, 1))
    torch.testing.assert_close(cuts[0][0], this, rtol=0, atol=1e-5)
    torch.testing.assert_close(cuts[1][0], torch.cat([this, before]), rtol=0, atol=1e-5)
    assert torch.equal(follow_in[:, 0, :3], follow_in[:, 0, 3:])  # the first frame is its own predecessor

"""APEX against its naive twin (tests/reference/apex.py), which the benchmark compares it with too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from apex_lab.config.building import build_model, build_schedules
from apex_lab.models.apex import Apex, merging
from apex_lab.nn.spatial_transformer import Paster, crop
from apex_lab.scene import Context, Noise, Scene, schedule_at
from tests.conftest import compose_job
from tests.models.apex.small import propose, spread
from tests.reference.apex import Straightforward, twins
from tests.reference.apex_merging import judged, merged, pixel_features
from tests.reference.grid import GridPaster, grid_crop

ALL, AS_MANY = "straightforward", "straightforward, renders as many"
MERGES = ("model.background.shadow=0.7", "model.merges=1", "model.start_size=0.4")
PIXELS = ("model.pixel_features=4", "model.whole_colours=true", "model.piece_price=10")
ROUNDS = ("model.merges=3", "model.piece_price=4", "model.hollow_price=2")
DOUBLE = 1e-9
"""How far apart two calculations in float64 may be, absolutely and of the number."""


def pair(*words: str, twin: str = ALL) -> tuple[Apex, Straightforward, Context]:
    """The tiny APEX, one of its twins with the same weights, and the context of some step."""
    job = compose_job("model=apex", "data=p2d", "scale=smoke", "model.start_presence=0.5", *words)
    model = build_model(job.config)
    assert isinstance(model, Apex)
    with torch.no_grad():
        for p in model.discovery.head_pres.parameters():
            p.mul_(20.0)  # so that some cells propose an object and some do not
    schedule = {name: value(3) for name, value in build_schedules(job.config).items()}
    values = schedule_at({**schedule, "sigma_fg_scale": 2.5, "sigma_bg_scale": 1.6})
    return model, twins(model, job.config.model)[twin], Context(values, detail=True)


VIDEO = torch.rand(3, 4, 3, 32, 32, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    ("twin", "words"),
    [
        (ALL, ("model.render_top=null",)),
        (AS_MANY, ()),
        (ALL, ("model.render_top=null", "+ablation=image_stn")),
        (ALL, ("model.render_top=null", "model.encoder.shortcuts=false", "model.glimpses.shortcut=false")),
        pytest.param(ALL, ("model.render_top=null", "+ablation=gaussian_scalor_norm"), marks=pytest.mark.slow),
        pytest.param(ALL, ("model.render_top=null", "model.likelihood.mixture_over=pixel"), marks=pytest.mark.slow),
    ],
    ids=[
        "all",
        "as many",
        "all, image_stn",
        "all, no shortcuts",
        "all, gaussian_scalor_norm",
        "all, mixture over pixels",
    ],
)
def test_the_twin_gives_the_same_terms_masks_and_gradients(twin: str, words: tuple[str, ...]) -> None:
    model, other, context = pair(*words, twin=twin)
    compared(model, other, [each.eval()(VIDEO, context) for each in (model, other)])


def merging_pair(*more: str, values: Mapping[str, float]) -> tuple[Apex, Straightforward, Context]:
    """Model and twin in float64, of whose cells about half propose something; pixels have something to say to masks.

    values: of schedules.
    """
    torch.manual_seed(0)
    model, other, context = pair(*MERGES, *more, twin=AS_MANY)
    if model.pixels is not None:
        torch.nn.init.normal_(model.pixels.query.weight)
        torch.nn.init.normal_(model.pixels.query.bias)
    spread(model.discovery.head_pres[-1], 0.0, 4.0, lambda: propose(model))
    other.load_state_dict(model.state_dict())
    schedule = {name: value.double() for name, value in {**context.schedule, **schedule_at(values)}.items()}
    return model.double(), other.double(), replace(context, schedule=schedule)


@pytest.mark.parametrize("training", [False, True], ids=["evaluation", "training"])
@pytest.mark.parametrize(
    ("more", "values"),
    [
        ((), {"shadow": 0.5}),
        (PIXELS, {"refinement": 0.5}),
        (PIXELS, {"refinement": 0.0, "shadow": 0.4}),
        ((*PIXELS, *ROUNDS), {"refinement": 1.0, "sigma_fg_scale": 10.0, "sigma_bg_scale": 20.0}),
        pytest.param((*PIXELS, "+ablation=gaussian_scalor_norm"), {"refinement": 0.7}, marks=pytest.mark.slow),
        pytest.param((*PIXELS, "model.background.bias_image=none"), {}, marks=pytest.mark.slow),
    ],
    ids=[
        "",
        "pixels and whole colours, half way",
        "pixels and whole colours, not yet",
        "three rounds at a price",
        "pixels, gaussian_scalor_norm",
        "pixels without a bias image",
    ],
)
def test_the_twin_merges_and_casts_shadows_too(
    training: bool, more: tuple[str, ...], values: Mapping[str, float]
) -> None:
    model, other, context = merging_pair(*more, values=values)
    for each in (model, other):
        each.train(training)
    video, drawn = VIDEO.double(), Kept()
    torch.manual_seed(2)
    fast = model(video, replace(context, noise=drawn))
    plain = other(video, replace(context, noise=Given(by_frame(drawn.numbers, *video.shape[:2]))))
    compared(model, other, [fast, plain], DOUBLE)
    model.merges = 0
    torch.manual_seed(2)
    assert not torch.equal(model(video, replace(context, noise=Kept())).masks, fast.masks)


PRICES = ((0.0, 0.0), (2.0, 0.0), (4.0, 2.0), (6.0, 5.0))
"""piece_price and hollow_price, in a mixture so wide that images say little."""


@pytest.mark.parametrize("more", [("model.start_size=0.18",), PIXELS], ids=["small things", "pixels"])
def test_the_twin_judges_every_pair_alike_at_every_price(
    more: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"refinement": 0.5, "shadow": 0.5, "sigma_fg_scale": 10.0, "sigma_bg_scale": 20.0}
    model, other, context = merging_pair("model.render_top=6", *more, values=values)
    schedule, video = context.schedule, VIDEO.double()
    images, told = video.flatten(0, 1), []

    def best_of(gain: Tensor, frame: Tensor, frames: int) -> Tensor:
        told.append((frame, gain))
        return merging_best_of(gain, frame, frames)

    merging_best_of = merging.best_of
    monkeypatch.setattr(merging, "best_of", best_of)
    with torch.no_grad():
        maps, _ = model.encoder(video)
        source = maps.flatten(0, 1)
        torch.manual_seed(2)
        found = model.discovery(source, source, model.glimpses, model.appearance, Noise())
        rank, most = found.prob.argsort(1, descending=True).argsort(1), torch.arange(12)[:, None] * 2 // 3
        prob = torch.where(rank < most, 0.5 + 0.2 * found.prob, 0.5 * found.prob)  # none to seven are there
        found = found._replace(prob=prob)
        evidence, features = model._evidence(images, schedule), pixel_features(other, images, schedule)
        assert (evidence is None) == (more != PIXELS)
        if evidence is not None:
            torch.testing.assert_close(evidence, features, rtol=DOUBLE, atol=DOUBLE)
        outcomes = set()
        for piece, hollow in PRICES:
            for each in (model, other):
                each.piece_price, each.hollow_price = piece, hollow
            fast = merging.merged(model, found, images, source, schedule, evidence)
            plain = merged(other, found, images, source, features, schedule)
            frame, gain = told.pop()
            unions = judged(other, found, images, source, features, schedule)
            assert frame.tolist() == [f for f, pairs in enumerate(unions) for _ in pairs]
            assert gain.tolist() == pytest.approx(
                [nats for pairs in unions for nats, _ in pairs], rel=DOUBLE, abs=DOUBLE
            )
            for a, b in zip((*fast.q_what, *fast[2:]), (*plain.q_what, *plain[2:]), strict=True):
                torch.testing.assert_close(a, b, rtol=DOUBLE, atol=DOUBLE)
            outcomes.add(tuple(map(tuple, (fast.prob == 0).nonzero().tolist())))
    assert len(outcomes) >= 3


class Kept(Noise):
    """Keeps the numbers that it draws."""

    def __init__(self) -> None:
        self.numbers: list[torch.Tensor] = []

    def normal(self, like: torch.Tensor) -> torch.Tensor:
        self.numbers.append(super().normal(like))
        return self.numbers[-1]

    def uniform(self, like: torch.Tensor) -> torch.Tensor:
        self.numbers.append(super().uniform(like))
        return self.numbers[-1]


class Given(Noise):
    """Gives numbers out, one draw after the other."""

    def __init__(self, numbers: Iterable[torch.Tensor]) -> None:
        self.numbers = iter(numbers)

    def normal(self, like: torch.Tensor) -> torch.Tensor:
        return next(self.numbers).view_as(like)

    def uniform(self, like: torch.Tensor) -> torch.Tensor:
        return next(self.numbers).view_as(like)


def by_frame(numbers: list[torch.Tensor], b: int, t: int) -> Iterator[torch.Tensor]:
    """The model's draws (discovery of all frames, six of each frame's loop, background of all) in the twin's order."""
    if not numbers:  # in evaluation nothing is drawn
        return
    where, what, *loop, background = (x.unflatten(0, (b, t, -1)) if i < 2 else x for i, x in enumerate(numbers))
    for i in range(t):
        yield where[:, i].flatten(0, 1)
        yield what[:, i].flatten(0, 1)
        yield from loop[6 * i : 6 * i + 6]
        yield background.unflatten(0, (b, t))[:, i]


def compared(model: Apex, other: Straightforward, scenes: list[Scene], bound: float | None = None) -> None:
    """Checks that model and twin say the same of a video, with the same gradients.

    bound: how far apart numbers may be, absolutely and of the number; None: as far as in float32.
    """
    fast, plain = scenes
    assert (fast.ids[:, :, :-1] > 0).any()
    assert torch.equal(fast.ids, plain.ids)
    for name in fast.terms:
        rtol, atol = (bound, bound) if bound else (2e-5, 1e-3)
        torch.testing.assert_close(fast.terms[name], plain.terms[name], rtol=rtol, atol=atol, msg=name)
    for name in ("masks", "presence", "appearance", "reconstruction", "windows", "means"):
        rtol, atol = (bound, bound) if bound else (1e-4, 1e-5)
        torch.testing.assert_close(
            getattr(fast, name), getattr(plain, name), rtol=rtol, atol=atol, equal_nan=True, msg=name
        )
    for scene in scenes:
        torch.stack([term.sum() for term in scene.terms.values()]).sum().backward()
    for (name, a), b in zip(model.named_parameters(), other.parameters(), strict=True):
        if a.grad is None:
            assert b.grad is None
        else:
            assert b.grad is not None
            largest = float(a.grad.abs().max())
            rtol, atol = (bound, bound * (1 + largest)) if bound else (1e-3, 1e-4 * largest + 1e-5)
            torch.testing.assert_close(a.grad, b.grad, rtol=rtol, atol=atol, msg=name)


def test_cells_that_hold_nothing_make_no_difference_to_a_rendered_frame() -> None:
    model, twin, context = pair("model.render_top=6", "model.max_objects=16")
    last = model.discovery.head_pres[-1]
    assert isinstance(last, torch.nn.Linear)
    present = torch.tensor(16)
    with torch.no_grad():
        while present.max() > 6:  # until no frame has more objects than are rendered
            last.bias.sub_(0.1)
            twin.load_state_dict(model.state_dict())
            fast, plain = (each.eval()(VIDEO, context) for each in (model, twin))
            present = (plain.ids[:, :, :-1] > 0).sum(-1)
    assert present.max() > 0
    torch.testing.assert_close(fast.terms["nll"], plain.terms["nll"], rtol=2e-5, atol=1e-3)


def test_grid_sampling_is_the_same_spatial_transformer() -> None:
    torch.manual_seed(0)
    windows = torch.cat([torch.rand(2, 5, 2) * 0.8 + 0.05, torch.rand(2, 5, 2) * 2.4 - 1.2], dim=-1)
    image = torch.randn(2, 3, 12, 12)
    torch.testing.assert_close(grid_crop(image, windows, 6), crop(image, windows, 6), rtol=1e-4, atol=1e-5)
    by_grid, by_matrix = GridPaster(windows, 8, 24), Paster(windows, 8, 24)
    glimpses = torch.randn(2, 5, 3, 8, 8)
    torch.testing.assert_close(by_grid.each(glimpses), by_matrix.each(glimpses), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        by_grid.total(glimpses[:, :, 0]), by_matrix.total(glimpses[:, :, 0]), rtol=1e-4, atol=1e-5
    )
    for a, b in zip(by_grid.inside(), by_matrix.inside(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)

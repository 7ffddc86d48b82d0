"""APEX against its naive twin (tests/reference/apex.py), which the benchmark compares it with too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import pytest
import torch

from apex_lab.config.building import build_model, build_schedules
from apex_lab.models.apex import Apex
from apex_lab.nn.spatial_transformer import Paster, crop
from apex_lab.scene import Context, Noise, Scene, schedule_at
from tests.conftest import compose_job
from tests.models.apex.small import propose, spread
from tests.reference.apex import Straightforward, twins
from tests.reference.grid import GridPaster, grid_crop

ALL, AS_MANY = "straightforward", "straightforward, renders as many"
MERGES = ("model.background.shadow=0.7", "model.merges=1", "model.start_size=0.4")
PIXELS = ("model.pixel_features=4", "model.whole_colours=true", "model.piece_price=10")


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
        pytest.param(ALL, ("model.render_top=null", "+ablation=gaussian_scalor_norm"), marks=pytest.mark.slow),
        pytest.param(ALL, ("model.render_top=null", "model.likelihood.mixture_over=pixel"), marks=pytest.mark.slow),
    ],
    ids=["all", "as many", "all, image_stn", "all, gaussian_scalor_norm", "all, mixture over pixels"],
)
def test_the_twin_gives_the_same_terms_masks_and_gradients(twin: str, words: tuple[str, ...]) -> None:
    model, other, context = pair(*words, twin=twin)
    compared(model, other, [each.eval()(VIDEO, context) for each in (model, other)])


@pytest.mark.parametrize("training", [False, True], ids=["evaluation", "training"])
@pytest.mark.parametrize("more", [(), PIXELS], ids=["", "pixels and whole colours, half way"])
def test_the_twin_merges_and_casts_shadows_too(training: bool, more: tuple[str, ...]) -> None:
    torch.manual_seed(0)
    model, other, context = pair(*MERGES, *more, twin=AS_MANY)
    if model.pixels is not None:
        torch.nn.init.normal_(model.pixels.query.weight)
        context = replace(context, schedule={**context.schedule, **schedule_at({"refinement": 0.5})})
    spread(model.discovery.head_pres[-1], 0.0, 4.0, lambda: propose(model))
    other.load_state_dict(model.state_dict())
    for each in (model, other):
        each.double().train(training)
    video, drawn = VIDEO.double(), Kept()
    torch.manual_seed(2)
    fast = model(video, replace(context, noise=drawn))
    plain = other(video, replace(context, noise=Given(by_frame(drawn.numbers, *video.shape[:2]))))
    compared(model, other, [fast, plain])
    model.merges = 0
    torch.manual_seed(2)
    assert not torch.equal(model(video, replace(context, noise=Kept())).masks, fast.masks)


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


def compared(model: Apex, other: Straightforward, scenes: list[Scene]) -> None:
    """Checks that model and twin say the same of a video, with the same gradients."""
    fast, plain = scenes
    assert (fast.ids[:, :, :-1] > 0).any()
    assert torch.equal(fast.ids, plain.ids)
    for name in fast.terms:
        torch.testing.assert_close(fast.terms[name], plain.terms[name], rtol=2e-5, atol=1e-3, msg=name)
    for name in ("masks", "presence", "appearance", "reconstruction", "windows", "means"):
        torch.testing.assert_close(
            getattr(fast, name), getattr(plain, name), rtol=1e-4, atol=1e-5, equal_nan=True, msg=name
        )
    for scene in scenes:
        torch.stack([term.sum() for term in scene.terms.values()]).sum().backward()
    for (name, a), b in zip(model.named_parameters(), other.parameters(), strict=True):
        if a.grad is None:
            assert b.grad is None
        else:
            assert b.grad is not None
            torch.testing.assert_close(
                a.grad, b.grad, rtol=1e-3, atol=1e-4 * float(a.grad.abs().max()) + 1e-5, msg=name
            )


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

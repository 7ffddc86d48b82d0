"""What holds for every `SceneModel`, as functions that take a `Case` and raise AssertionError (docs/architecture.md).

    @pytest.mark.parametrize("check", CHECKS, ids=name_of)
    def test_contract(check: Check) -> None:
        check(Case(MyModel(image_size=32), frames=5, side=32))

Every check works on a copy of the model. Comparisons are made in float64, where rounding flips no decision.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from apex_lab.nn.noise import RankNoise, VideoNoise
from apex_lab.scene import ABSENT, Context, Noise, Scene, SceneModel, Statistics, schedule_at

SHORT = 3
"""Frames that reach every part of a model: discovery, propagation, and propagation of what was propagated."""

VIDEOS = 4
"""Videos of a batch: two ranks of two."""

STIR = 0.03
"""Standard deviation of what is added to all weights, so that none is at a special value such as zero."""


@dataclass(frozen=True)
class Case:
    """A model and the videos that it is tried on.

    Attributes:
        model: freshly built, small.
        frames: of a video; at least 3, so that it can be cut into chunks of different lengths.
        side: H = W of a video in pixels.
        schedule: value of each scheduled name; what is left out gets 0.5, or the middle of a range without it.
        without_gradient: names of weights whose gradient is zero for a reason.
        dtype: of comparisons.
    """

    model: SceneModel
    frames: int
    side: int
    schedule: Mapping[str, float] = field(default_factory=dict)
    without_gradient: frozenset[str] = frozenset()
    dtype: torch.dtype = torch.float64

    @property
    def name(self) -> str:
        return type(self.model).__name__

    def ready(self, training: bool = False, dtype: torch.dtype | None = None) -> SceneModel:
        """A copy of the model, initialised, with stirred weights."""
        torch.manual_seed(0)
        model = copy.deepcopy(self.model)
        model.initialise(Statistics(lambda: self.batch()[0].float().mean(dim=(0, 1))))
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(STIR * torch.randn_like(parameter))
        return model.to(self.dtype if dtype is None else dtype).train(training)

    def batch(self, dtype: torch.dtype | None = None) -> tuple[Tensor, Tensor]:
        """Videos (B, T, 3, H, W) and labels (B, T, H, W): squares that glide over a plain ground."""
        generator = torch.Generator().manual_seed(1)
        b, t, side = VIDEOS, self.frames, self.side
        video = torch.rand(b, 1, 3, 1, 1, generator=generator).expand(b, t, 3, side, side).clone()
        labels = torch.zeros(b, t, side, side, dtype=torch.long)
        for i in range(b):
            for k in (1, 2):
                colour = torch.rand(3, 1, 1, generator=generator)
                size = side // 4 + int(torch.randint(side // 8 + 1, (), generator=generator))
                y, x = torch.randint(side - size, (2,), generator=generator).tolist()
                for j in range(t):
                    across = slice(min(x + j, side - size), min(x + j, side - size) + size)
                    video[i, j, :, y : y + size, across] = colour
                    labels[i, j, y : y + size, across] = k
        video += 0.02 * torch.rand(video.shape, generator=generator)
        return video.clamp(0, 1).to(self.dtype if dtype is None else dtype), labels

    def values(self) -> dict[str, float]:
        """A value for each scheduled name."""
        middle = {n: 0.5 if low <= 0.5 <= high else (low + high) / 2 for n, (low, high) in self._ranges.items()}
        return {**middle, **self.schedule}

    @property
    def _ranges(self) -> Mapping[str, tuple[float, float]]:
        return self.model.schedule_ranges

    def context(self, noise: Noise | None = None, state: Any = None, detail: bool = False) -> Context:
        return Context(schedule_at(self.values()), noise or VideoNoise(0, range(VIDEOS)), state, detail)

    def evaluate(self, model: SceneModel, videos: Sequence[int] | None = None, **options: Any) -> Scene:
        """The scene of some videos of the batch, each with its own noise, in evaluation mode."""
        chosen = list(range(VIDEOS) if videos is None else videos)
        return self.chunk(model.eval(), chosen, range(self.frames), None, **options)

    @cached_property
    def scene(self) -> Scene:
        """Of the whole batch in evaluation; several checks look at it."""
        return self.evaluate(self.ready())

    @cached_property
    def detailed(self) -> Scene:
        """The same with `Context.detail`."""
        return self.evaluate(self.ready(), detail=True)

    @cached_property
    def trained(self) -> Scene:
        """Of the whole batch while training."""
        video, labels = self.batch()
        with torch.no_grad():
            return call(self.ready(training=True), video, labels, self.context())

    def short(self, values: Mapping[str, float], training: bool) -> Scene:
        """The scene of the first frames of one video, at given values of the schedules; with its posterior."""
        video, labels = (x[:1, :SHORT] for x in self.batch())
        model, context = self.ready(training), Context(schedule_at(values), VideoNoise(0, range(1)), detail=True)
        with torch.no_grad():
            scene = call(model, video, labels, context)
            if model.has_posterior and not training:
                model.posterior(scene, video, context)
        return scene

    def chunk(self, model: SceneModel, videos: list[int], frames: range, state: Any, **options: Any) -> Scene:
        """The scene of some frames, `state` being that of the frames before."""
        noise = VideoNoise(0, videos, frames.start)
        video, labels = (x[videos, frames.start : frames.stop] for x in self.batch())
        with torch.no_grad():
            return call(model, video, labels, self.context(noise, state, **options))


Check = Callable[[Case], None]


class Private(Noise):
    """Noise from a generator of its own."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(2)

    def normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generator, dtype=like.dtype)

    def uniform(self, like: Tensor) -> Tensor:
        return torch.rand(like.shape, generator=self.generator, dtype=like.dtype)


def call(model: SceneModel, video: Tensor, labels: Tensor, context: Context) -> Scene:
    """The model's scene, from the labels where it reads them."""
    return model.from_labels(video, labels, context) if model.needs_labels else model(video, context)


# --- one scene ---


def check_shapes(case: Case) -> None:
    """Every field has the shape and type of its annotation, and is finite and in its range."""
    scene = case.detailed
    b, t, h, w = VIDEOS, case.frames, case.side, case.side
    k = scene.masks.shape[2]
    shapes: dict[str, tuple[int, ...]] = {
        "masks": (b, t, k, h, w),
        "background": (k,),
        "ids": (b, t, k),
        "presence": (b, t, k),
        "appearance": (b, t, k, scene.appearance.shape[-1]),
        "reconstruction": (b, t, 3, h, w),
        "windows": (b, t, k, 4),
        "means": (b, t, k, 3, h, w),
    }
    for name, shape in shapes.items():
        value = getattr(scene, name)
        if value is None and name in ("windows", "means"):
            continue
        _require(tuple(value.shape) == shape, case, f"{name} has the shape {tuple(value.shape)}, not {shape}")
        if name in ("masks", "presence", "reconstruction", "means"):
            low, high = float(value.min()), float(value.max())
            _require(low >= -1e-6 and high <= 1 + 1e-6, case, f"{name} goes from {low} to {high}, outside [0, 1]")
        elif value.is_floating_point() and name != "windows":
            _require(bool(value.isfinite().all()), case, f"{name} is not finite")
    _require(scene.background.dtype == torch.bool, case, f"background is {scene.background.dtype}, not bool")
    _require(not scene.ids.is_floating_point(), case, f"ids are {scene.ids.dtype}, not whole numbers")
    for name, value in scene.diagnostics.items():
        _require(value.dim() == 0, case, f"diagnostics[{name!r}] has the shape {tuple(value.shape)}, not ()")


def check_masks_sum_to_one(case: Case) -> None:
    """At every pixel, while training and in evaluation; an absent component has no pixel."""
    for training, scene in ((True, case.trained), (False, case.scene)):
        error = float((scene.masks.sum(dim=2) - 1).abs().max())
        _require(error < 1e-4, case, f"masks sum to 1 but for {error} ({training=})")
        if not training and bool((scene.ids == ABSENT).any()):
            largest = float(scene.masks[scene.ids == ABSENT].max())
            _require(largest <= 1e-6, case, f"a component with the id {ABSENT} has a mask of {largest}")


def check_ids(case: Case) -> None:
    """No identity occurs twice in a frame; a background component always has one."""
    scene = case.scene
    for frame in scene.ids.flatten(0, 1).tolist():
        there = [i for i in frame if i != ABSENT]
        _require(len(there) == len(set(there)), case, f"ids {frame} repeat within a frame")
    _require(bool((scene.ids[..., scene.background] != ABSENT).all()), case, "the background has no id in some frame")


def check_detail(case: Case) -> None:
    """Costly fields are filled when they are asked for, and only then; the others do not change."""
    plain, detailed = case.scene, case.detailed
    for name in ("windows", "means"):
        _require(getattr(plain, name) is None, case, f"{name} is filled without Context.detail")
    _same(case, _without_detail(plain), _without_detail(detailed), "with and without Context.detail")


def check_terms(case: Case) -> None:
    """Loss terms have the names of `term_names`, and a finite value per video."""
    for training, scene in ((True, case.trained), (False, case.scene)):
        terms = scene.terms
        _require(
            set(terms) == set(case.model.term_names),
            case,
            f"terms are {sorted(terms)}, term_names {sorted(case.model.term_names)} ({training=})",
        )
        for name, value in terms.items():
            _require(tuple(value.shape) == (VIDEOS,), case, f"term {name!r} has the shape {tuple(value.shape)}")
            _require(bool(value.isfinite().all()), case, f"term {name!r} is not finite: {value.tolist()} ({training=})")


def check_posterior(case: Case) -> None:
    """Where there is a posterior over components, it is one: at every pixel it sums to 1."""
    if not case.model.has_posterior:
        return
    model, scene, (video, _) = case.ready(), case.detailed, case.batch()
    with torch.no_grad():
        found = model.posterior(scene, video, case.context(detail=True))
    _require(found.shape == scene.masks.shape, case, f"the posterior has the shape {tuple(found.shape)}")
    error = float((found.sum(dim=2) - 1).abs().max())
    _require(error < 1e-4, case, f"the posterior sums to 1 but for {error}")


# --- schedules ---


def check_schedule_names(case: Case) -> None:
    """`schedule_ranges` names what `forward` and `posterior` read: they need no more, and miss any that is left out,
    but for `optional_schedules`."""

    def missed(values: Mapping[str, float], training: bool) -> str | None:
        """The first name that is not there when the model looks for it."""
        try:
            case.short(values, training)
        except KeyError as error:
            return str(error.args[0])
        return None

    named, values = set(case.model.schedule_ranges), case.values()
    unknown = {name for training in (True, False) if (name := missed(values, training)) is not None}
    _require(not unknown, case, f"{sorted(unknown)} is read and not in schedule_ranges, which names {sorted(named)}")
    for name in sorted(named):
        others = {n: v for n, v in values.items() if n != name}
        read = any(missed(others, training) == name for training in (True, False))
        if name in case.model.optional_schedules:
            _require(not read, case, f"optional_schedules names {name!r}, which is missed when it is left out")
        else:
            _require(read, case, f"schedule_ranges names {name!r}, which is not read")


def check_schedule_ends(case: Case) -> None:
    """Terms are finite at both ends of every schedule's range."""
    for name, (low, high) in case.model.schedule_ranges.items():
        _require(low <= high, case, f"schedule_ranges[{name!r}] = {(low, high)} is empty")
        for value in (low, high):
            for term, found in case.short({**case.values(), name: value}, training=True).terms.items():
                _require(bool(found.isfinite().all()), case, f"term {term!r} is not finite at {name} = {value}")


# --- noise ---


def check_all_randomness_is_noise(case: Case) -> None:
    """The same noise gives the same scene, whatever the state of PyTorch's default generator."""
    video, labels = case.batch()
    for training in (True, False):
        model, scenes = case.ready(training), []
        for seed in (3, 4):
            torch.manual_seed(seed)
            with torch.no_grad():
                scenes.append(call(model, video, labels, case.context(Private())))
        _same(case, *scenes, f"with other global seeds ({training=})", tolerance=0.0)


def check_evaluation_repeats(case: Case) -> None:
    """A video has the same scene every time, and looking at it changes nothing in the model."""
    model = case.ready()
    before = copy.deepcopy(model.state_dict())
    first = case.evaluate(model)
    _same(case, first, case.evaluate(model), "when evaluated a second time", tolerance=0.0)
    for name, value in model.state_dict().items():
        _require(torch.equal(value, before[name]), case, f"evaluation changed {name}")


def check_order_of_videos(case: Case) -> None:
    """Videos in another order have the same scenes in that order."""
    model, order = case.ready(), [2, 0, 3, 1]
    _same(case, case.evaluate(model, order), _videos(case.scene, order), "in another order")


def check_independent_of_batch(case: Case) -> None:
    """A video has the same scene alone as beside others."""
    model = case.ready()
    for video in range(VIDEOS):
        _same(case, case.evaluate(model, [video]), _videos(case.scene, [video]), "alone")


def check_chunks(case: Case) -> None:
    """A video cut into chunks, each from the state of the one before, has the scene of the whole."""
    if not case.model.streams:
        return
    model, whole, t = case.ready(), case.scene, case.frames
    first = max(1, 3 * t // 7)
    for lengths in ([first, t - first], [1] * t):
        state, parts = None, []
        for frames in _stretches(lengths):
            scene = case.chunk(model.eval(), list(range(VIDEOS)), frames, state)
            parts.append(scene)
            state = scene.state
        _same(case, _joined(parts), whole, f"in chunks of {lengths} frames")


def check_ranks(case: Case) -> None:
    """Two ranks with half of the batch each compute, while training, what one computes.

    Batch normalisation uses its running statistics here: those of a rank's own videos differ by design.
    """
    model, (video, labels) = case.ready(training=True), case.batch()
    for module in model.modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            module.eval()

    def train(first: int, videos: int) -> Scene:
        torch.manual_seed(5)
        part = slice(first, first + videos)
        with torch.no_grad():
            return call(model, video[part], labels[part], case.context(RankNoise(videos, first, VIDEOS)))

    whole, half = train(0, VIDEOS), VIDEOS // 2
    for first in (0, half):
        chosen = list(range(first, first + half))
        _same(case, train(first, half), _videos(whole, chosen), f"on a rank with the videos {chosen}")


# --- gradients ---


def check_gradients(case: Case) -> None:
    """The loss has a finite gradient in every trainable weight, and it is not zero."""
    if not case.model.needs_training:
        return
    model, (video, labels) = case.ready(training=True), case.batch()
    terms = call(model, video, labels, case.context()).terms
    torch.stack([term.mean() for term in terms.values()]).sum().backward()
    trainable = {name: p.grad for name, p in model.named_parameters() if p.requires_grad}
    _require(bool(trainable), case, "no weight is trainable, but needs_training is True")
    missing = [name for name, grad in trainable.items() if grad is None]
    _require(not missing, case, f"no gradient reaches {missing}")
    broken = [name for name, grad in trainable.items() if grad is not None and not grad.isfinite().all()]
    _require(not broken, case, f"the gradient is not finite in {broken}")
    largest = max(float(grad.abs().max()) for grad in trainable.values() if grad is not None)
    zero = {n for n, g in trainable.items() if g is not None and float(g.abs().max()) <= 1e-13 * largest}
    unexpected = sorted(zero - case.without_gradient)
    _require(not unexpected, case, f"the gradient is zero in {unexpected}")


def check_no_grad(case: Case) -> None:
    """Runs where gradients are off; then its scene and its weights have none."""
    video, labels = case.batch()
    for training in (True, False):
        model = case.ready(training)
        with torch.no_grad():
            scene = call(model, video, labels, case.context(detail=True))
        tensors = {**_fields(scene), **{f"terms[{n!r}]": term for n, term in scene.terms.items()}}
        attached = [name for name, value in tensors.items() if value.requires_grad]
        _require(not attached, case, f"{attached} require a gradient under no_grad ({training=})")
        filled = [name for name, p in model.named_parameters() if p.grad is not None]
        _require(not filled, case, f"a pass under no_grad left gradients in {filled} ({training=})")


def check_half_precision(case: Case) -> None:
    """A training step under bfloat16 autocast: finite terms and gradients, masks that sum to 1."""
    if not case.model.needs_training:
        return
    model, (video, labels) = case.ready(True, torch.float32), case.batch(torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scene = call(model, video, labels, case.context())
    torch.stack([term.float().mean() for term in scene.terms.values()]).sum().backward()
    error = float((scene.masks.detach().float().sum(dim=2) - 1).abs().max())
    _require(error < 1e-2, case, f"masks sum to 1 but for {error} under bfloat16 autocast")
    broken = [n for n, p in model.named_parameters() if p.grad is not None and not p.grad.isfinite().all()]
    broken += [n for n, term in scene.terms.items() if not term.isfinite().all()]
    _require(not broken, case, f"{broken} are not finite under bfloat16 autocast")


CHECKS: tuple[Check, ...] = (
    check_shapes,
    check_masks_sum_to_one,
    check_ids,
    check_detail,
    check_terms,
    check_posterior,
    check_schedule_names,
    check_schedule_ends,
    check_all_randomness_is_noise,
    check_evaluation_repeats,
    check_order_of_videos,
    check_independent_of_batch,
    check_chunks,
    check_ranks,
    check_gradients,
    check_no_grad,
    check_half_precision,
)


def name_of(check: Check) -> str:
    """Name of a check in a test's id."""
    return check.__name__.removeprefix("check_")


# --- scenes as values ---


def _require(holds: bool, case: Case, message: str) -> None:
    if not holds:
        raise AssertionError(f"{case.name}: {message}")


def _fields(scene: Scene) -> dict[str, Tensor]:
    """Fields with a value per video."""
    names = ("masks", "ids", "presence", "appearance", "reconstruction", "windows", "means")
    return {name: value for name in names if (value := getattr(scene, name)) is not None}


def _with(scene: Scene, fields: Mapping[str, Tensor], terms: Mapping[str, Tensor]) -> Scene:
    values = {"windows": None, "means": None, **fields}
    return Scene(background=scene.background, terms=dict(terms), **values)  # type: ignore[arg-type]


def _videos(scene: Scene, videos: list[int]) -> Scene:
    fields = {name: value[videos] for name, value in _fields(scene).items()}
    return _with(scene, fields, {name: term[videos] for name, term in scene.terms.items()})


def _without_detail(scene: Scene) -> Scene:
    fields = {name: value for name, value in _fields(scene).items() if name not in ("windows", "means")}
    return _with(scene, fields, scene.terms)


def _joined(parts: list[Scene]) -> Scene:
    """Chunks -> the whole: frames one after the other, terms summed, or averaged by the weights that they have."""
    first = parts[0]
    fields = {name: torch.cat([_fields(part)[name] for part in parts], dim=1) for name in _fields(first)}
    weights = [1.0 if part.terms_weight is None else part.terms_weight for part in parts]
    total = 1.0 if first.terms_weight is None else sum(weights)
    terms = {
        name: sum(part.terms[name] * (weight / total) for part, weight in zip(parts, weights, strict=True))
        for name in first.terms
    }
    return _with(first, fields, terms)


def _stretches(lengths: Iterable[int]) -> Iterator[range]:
    start = 0
    for length in lengths:
        yield range(start, start + length)
        start += length


def _same(case: Case, found: Scene, expected: Scene, when: str, tolerance: float = 1e-5) -> None:
    """Fails where a field or a term differs, relative to its largest value."""
    pairs = {name: (value, _fields(found).get(name)) for name, value in _fields(expected).items()}
    pairs |= {f"terms[{name!r}]": (term, found.terms.get(name)) for name, term in expected.terms.items()}
    for name, (wanted, value) in pairs.items():
        _require(value is not None and value.shape == wanted.shape, case, f"{name} has another shape {when}")
        assert value is not None
        if not wanted.is_floating_point():
            _require(torch.equal(value, wanted), case, f"{name} differ {when}")
            continue
        _require(torch.equal(value.isnan(), wanted.isnan()), case, f"{name} has NaN at other places {when}")
        error = float((value - wanted).nan_to_num().abs().max())
        limit = tolerance * max(1.0, float(wanted.nan_to_num().abs().max()))
        _require(error <= limit, case, f"{name} differs by {error:.2g} {when}")

"""The model against its naive twin: the same terms, masks, ids and gradients from the same noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from apex_lab.models.scalor import AnchoredSize, Scalor
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import schedule_at
from tests.models.scalor.small import SCHEDULE, clip, run, small
from tests.reference.scalor import NaiveScalor, Result


def twin(model: Scalor, video: torch.Tensor, **schedule: float) -> Result:
    noise = VideoNoise(0, list(range(len(video))))
    return NaiveScalor(model)(video, schedule_at({**SCHEDULE, **schedule}), noise)


def named(name: str) -> Callable[[str], str]:
    """Message of a failed comparison, with the name of what was compared."""
    return lambda message: f"{name}: {message}"


def gradients(model: Scalor, terms: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    names, parameters = zip(*model.named_parameters(), strict=True)
    found = torch.autograd.grad(sum(terms.values()).sum(), parameters, allow_unused=True)  # type: ignore[union-attr]
    return {n: torch.zeros_like(p) if g is None else g for n, p, g in zip(names, parameters, found, strict=True)}


CASES: list[tuple[dict[str, Any], dict[str, float]]] = [
    ({}, {}),
    ({"size": AnchoredSize(), "image_size": 64, "glimpse_size": 32}, {"slot_gradient": 0.0, "temperature": 0.5}),
    ({"max_objects": 3, "recompute": "everything"}, {"slot_gradient": 0.0}),
    ({"max_objects": 40, "background_decoder": "weak", "recompute": "objects"}, {"alpha_curriculum": 1.0}),
]


@pytest.fixture
def double() -> Iterator[None]:
    """The twin makes tensors of the default type."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize(("arguments", "schedule"), CASES)
def test_same_terms_masks_and_gradients(arguments: dict[str, Any], schedule: dict[str, float]) -> None:
    """In double precision: in single, rounding grows in the loop over time to half a percent of a gradient."""
    model = small(**arguments)
    video = clip(2, 4, model.image_size)
    got, want = run(model, video, **schedule), twin(model, video, **schedule)
    assert max(len(frame) for row in want.masks for frame in row) > 2, "the example should have objects"
    for name in model.term_names:
        torch.testing.assert_close(got.terms[name], want.terms[name], rtol=1e-7, atol=1e-6, msg=named(name))
    torch.testing.assert_close(got.reconstruction, want.reconstruction, rtol=0, atol=1e-6)
    for i, row in enumerate(want.masks):
        for t, frame in enumerate(row):
            ids = got.ids[i, t].tolist()
            assert sorted(k for k in ids if k >= 0) == sorted(frame)
            for name, mask in frame.items():
                torch.testing.assert_close(got.masks[i, t, ids.index(name)], mask, rtol=0, atol=1e-6)
    ours, theirs = gradients(model, got.terms), gradients(model, want.terms)
    for name, gradient in theirs.items():
        scale = float(gradient.abs().max()) + 1e-3
        torch.testing.assert_close(ours[name], gradient, rtol=0, atol=1e-6 * scale, msg=named(name))


@pytest.mark.parametrize("slots", [20, 3])
def test_same_in_evaluation(slots: int) -> None:
    """With 3 slots, more cells are discovered than find one."""
    model = small(evaluation_objects=slots).eval()
    video = clip(2, 4)
    with torch.no_grad():
        got, want = run(model, video), twin(model, video)
    for name in model.term_names:
        torch.testing.assert_close(got.terms[name], want.terms[name], rtol=1e-4, atol=1e-2, msg=named(name))
    for i, row in enumerate(want.masks):
        for t, frame in enumerate(row):
            ids = got.ids[i, t].tolist()
            assert sorted(k for k in ids if k >= 0) == sorted(frame)
            for name, mask in frame.items():
                torch.testing.assert_close(got.masks[i, t, ids.index(name)], mask, rtol=0, atol=1e-3)

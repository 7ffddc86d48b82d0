"""The model against its twin, which writes the published computation down (`tests/reference/space.py`)."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tests.models.space.common import close, context, small, video
from tests.reference.space import NaiveSpace

CASES = [
    pytest.param({}, {}, True, id="training"),
    pytest.param({}, {"fix_alpha": 1.0, "fixed_alpha": 0.2}, True, id="fixed_alpha"),
    pytest.param({"sigma_fg": 0.1, "sigma_bg": 0.04, "scale_std": 0.2}, {}, False, id="evaluation"),
    pytest.param({"components": 1}, {}, True, id="one_component"),
    pytest.param({"image_size": 64, "grid": 4, "components": 2}, {}, True, id="64px"),
]


@pytest.mark.parametrize(("sizes", "values", "training"), CASES)
def test_terms_masks_and_gradients(sizes: dict, values: dict, training: bool) -> None:
    sizes = {"image_size": 32, "grid": 4, "components": 3, **sizes}
    model = small(**sizes)
    twin = NaiveSpace(model, **sizes)
    side = sizes["image_size"]
    frames = video(shape=(2, 2, 3, side, side))
    scenes = []
    for module in (model.train(training), twin.train(training)):
        torch.manual_seed(5)
        scene = module(frames, context(**values))
        torch.stack([term.sum() for term in scene.terms.values()]).sum().backward()
        scenes.append(scene)
    found, expected = scenes
    assert found.terms.keys() == expected.terms.keys() == set(model.term_names)
    for name in model.term_names:
        close(found.terms[name], expected.terms[name], 1e-5)
    torch.testing.assert_close(found.masks, expected.masks, atol=2e-4, rtol=0)
    torch.testing.assert_close(found.reconstruction, expected.reconstruction, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.presence, expected.presence, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.appearance, expected.appearance, atol=1e-4, rtol=0)
    assert found.ids.equal(expected.ids)
    for mine, name, theirs in twin.parameter_pairs(model):
        if mine.grad is None or theirs.grad is None:
            assert mine.grad is None
            assert theirs.grad is None
        elif not (training and before_batch_norm(name)):
            close(theirs.grad, mine.grad, 2e-3)
    for mine, theirs in zip(running(twin), running(model), strict=True):
        torch.testing.assert_close(theirs, mine)


def before_batch_norm(name: str) -> bool:
    """Biases that BatchNorm takes away: the gradient is rounding alone."""
    stacks = ("background.image_encoder", "background.component_encoder", "background.component_decoder")
    return name.startswith(stacks) and name.endswith("0.bias")


def running(module: nn.Module) -> list[Tensor]:
    """Running statistics, in the order of the layers (both define the background's in the same order)."""
    return [buffer for name, buffer in module.named_buffers() if "running" in name]

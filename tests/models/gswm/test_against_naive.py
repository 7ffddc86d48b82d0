"""The model and its naive twin: the same terms, masks, identities and gradients from the same weights and noise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apex_lab.models.gswm import Gswm
from apex_lab.models.gswm.history import Environment
from apex_lab.nn.noise import RankNoise
from apex_lab.scene import Context
from tests.models.gswm.small import context, double, loss, tiny, video
from tests.reference.gswm import Naive

__all__ = ["double"]
pytestmark = pytest.mark.usefixtures("double")


def both(model: Gswm, training: bool, **changes: float) -> tuple[Any, dict[str, Tensor], Naive]:
    twin = Naive(model)
    model.train(training)
    twin.train(training)
    x = video()
    return model(x, context(**changes)), twin(x, context(**changes)), twin


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("environment", ["attention", "whole", "none"])
def test_terms_masks_and_identities(environment: Environment, training: bool) -> None:
    model = tiny(environment=environment)
    scene, expected, _ = both(model, training)
    for name in model.term_names:
        torch.testing.assert_close(scene.terms[name], expected[name], rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(scene.masks[:, :, :-1], expected["masks"], rtol=0, atol=1e-9)
    torch.testing.assert_close(scene.reconstruction, expected["reconstruction"], rtol=0, atol=1e-9)
    assert torch.equal(scene.ids[:, :, :-1], expected["ids"])


def test_gradients() -> None:
    """Of parts whose weights both have in the same form, and of the sum of both chains' other ones."""
    model = tiny()
    twin = Naive(model)
    x = video()
    loss(model(x, context()).terms).backward()
    out = twin(x, context())
    loss({name: out[name] for name in model.term_names}).backward()
    background = model.background
    assert background is not None
    same: list[tuple[nn.Module, nn.Module]] = [
        (background.encoder, twin.bg_encoder),
        (background.decoder, twin.bg_decoder),
        (background.q_cell, twin.bg_q_cell),
        (background.p_lstm, twin.bg_p_cell),
        (model.image_encoder.conv, twin.resnet[0]),
        (model.image_encoder.stages[1], twin.resnet[4]),
        (model.image_encoder.head, twin.resnet[-1]),
        (model.discovery.map_net, twin.map_net),
        (model.discovery.attribute_head, twin.attribute_head),
        (model.propagation.grow_net, twin.grow),
        (model.propagation.encoder, twin.encoder),
        (model.propagation.change_net, twin.change),
        (model.history.encoder, twin.env),
        (model.renderer.decoder, twin.decoder),
    ]
    for ours, theirs in same:
        for (name, a), b in zip(ours.named_parameters(), theirs.parameters(), strict=True):
            assert a.grad is not None
            assert b.grad is not None, name
            torch.testing.assert_close(a.grad, b.grad, rtol=1e-6, atol=1e-6 * (1 + b.grad.abs().max().item()))
    nets = model.history.interaction
    for chain, theirs in enumerate((twin.q_chain, twin.p_chain)):
        for ours, net in ((nets.pair_net, theirs.pair_net), (nets.logit_net, theirs.logit_net)):
            for layer, linear in zip(
                (ours.first, ours.second, ours.last), (m for m in net if isinstance(m, nn.Linear)), strict=True
            ):
                scale = linear.weight.grad.abs().max().item()
                torch.testing.assert_close(layer.weight.grad[chain].T, linear.weight.grad, rtol=1e-6, atol=1e-6 * scale)


@pytest.mark.parametrize("draw", ["balanced", "batch"])
def test_other_draws_of_the_frames_that_discover(draw: Any) -> None:
    """With statistics of its own for each image: `balanced` encodes other ones together than the twin does."""
    model = tiny(discovery_draw=draw)
    twin = Naive(model)
    for net in (model, twin):
        for part in (part for part in net.modules() if isinstance(part, nn.BatchNorm2d)):
            part.eval()
    x = video()
    scene, expected = model(x, context()), twin(x, context())
    for name in model.term_names:
        torch.testing.assert_close(scene.terms[name], expected[name], rtol=1e-8, atol=1e-8)
    assert torch.equal(scene.ids[:, :, :-1], expected["ids"])


@pytest.mark.parametrize("draw", ["independent", "batch"])
def test_frames_in_which_no_video_discovers(draw: Any) -> None:
    """They are not encoded, as published: neither the terms nor batch normalisation's statistics have them."""
    model = tiny(discovery_dropout=0.8, discovery_draw=draw)
    scene, expected, twin = both(model, True)
    ours, theirs = model.image_encoder.norm, twin.resnet[1]
    assert isinstance(ours, nn.BatchNorm2d)
    assert isinstance(theirs, nn.BatchNorm2d)
    assert 1 <= int(ours.num_batches_tracked) < 5  # of the video's 5 frames
    assert ours.num_batches_tracked == theirs.num_batches_tracked
    torch.testing.assert_close(ours.running_mean, theirs.running_mean)
    torch.testing.assert_close(ours.running_var, theirs.running_var)
    for name in model.term_names:
        torch.testing.assert_close(scene.terms[name], expected[name], rtol=1e-8, atol=1e-8)
    loss(scene.terms).backward()
    loss({name: expected[name] for name in model.term_names}).backward()
    for a, b in zip(model.image_encoder.conv.parameters(), twin.resnet[0].parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-6, atol=1e-6 * b.grad.abs().max().item())


def test_training_noise() -> None:
    """In training, numbers come from one generator: the twin draws them in the model's order."""
    model = tiny()
    twin = Naive(model)
    x, schedule = video(), context().schedule
    found = []
    for net in (model, twin):
        torch.manual_seed(0)
        found.append(net.train()(x, Context(schedule, RankNoise(len(x), 0, len(x)))))
    for name in model.term_names:
        torch.testing.assert_close(found[0].terms[name], found[1][name], rtol=1e-8, atol=1e-8)


def test_running_statistics() -> None:
    """Batch normalisation sees frame after frame, as in the twin, also where convolutions see several at once."""
    model = tiny(discovery_dropout=0.0)
    _, _, twin = both(model, True)
    ours = model.image_encoder.norm
    assert isinstance(ours, nn.BatchNorm2d)
    theirs = twin.resnet[1]
    torch.testing.assert_close(ours.running_mean, theirs.running_mean)
    torch.testing.assert_close(ours.running_var, theirs.running_var)

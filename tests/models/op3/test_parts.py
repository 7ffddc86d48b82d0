"""OP3's parts against arrays of the published implementation, closed forms against autograd, and counts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.models.op3 import Op3
from apex_lab.models.op3.decoder import Decoder, conv_by_pairs
from apex_lab.models.op3.dynamics import Dynamics
from apex_lab.models.op3.likelihood import image_gradients, mixture
from apex_lab.models.op3.plan import Plan, listed
from apex_lab.models.op3.posterior import UNIT_RAW, RawGaussian, kl, parameter_gradients, variance_of
from apex_lab.models.op3.refinement import ImageNorm, VectorNorm, _PooledElu
from apex_lab.nn.tiled_conv import TiledConv, coordinate_maps

ARRAYS = np.load(Path(__file__).parent / "fixtures" / "op3.npz", allow_pickle=False)


def array(name: str) -> Tensor:
    """An array of the published implementation."""
    return torch.from_numpy(ARRAYS[name].astype(np.float32))


def assert_near(found: Tensor, wanted: Tensor, tolerance: float = 1e-4) -> None:
    """Within `tolerance` of the largest wanted value."""
    found, wanted = found.detach(), wanted.detach()
    assert found.shape == wanted.shape
    assert float((found - wanted).abs().max()) <= tolerance * float(wanted.abs().max())


def test_softplus_of_the_raw_scale_is_the_variance() -> None:
    assert_near(variance_of(array("std/raw")).sqrt(), array("std/std"))
    assert float(variance_of(torch.tensor(UNIT_RAW)).sqrt()) == pytest.approx(1.000005, abs=1e-6)


def test_kl() -> None:
    posterior = RawGaussian(array("kl/post_mean"), array("kl/post_raw"))
    prior = RawGaussian(array("kl/prior_mean"), array("kl/prior_raw"))
    assert_near(kl(posterior, prior), array("kl/kl_bk"))
    assert float(kl(posterior, posterior).abs().max()) < 1e-6
    assert float(array("kl/initial_prior_raw")[0]) == pytest.approx(UNIT_RAW, rel=1e-3)


def test_mixture_and_its_gradients() -> None:
    image, colours, logits = array("mix/image"), array("mix/colors"), array("mix/mask_logits")[:, :, 0]
    found = mixture(image, colours, logits, 0.1)
    assert_near(found.masks, array("mix/mask")[:, :, 0])
    assert_near(found.by_slot, array("mix/pixel_slot_density"))
    assert_near(found.density, array("mix/pixel_density"))
    assert_near(found.density[:, None] - found.masks * found.by_slot, array("mix/leave_one_out"))
    assert_near(found.nll().mean(), array("mix/nll"))
    divided = found.by_slot / (found.by_slot.sum(1, keepdim=True) + 1e-8)
    assert_near(divided, array("mix/resp_likelihood_only"))
    gradients = image_gradients(image, colours, found, 0.1)
    assert_near(gradients.masks / len(image), array("mix/grad_mask")[:, :, 0])
    assert_near(gradients.colours / len(image), array("mix/grad_colors"))
    total = found.nll().mean() + 0.01 * array("mix/kl_loss")
    assert_near(total, array("mix/total"))


def test_perfect_pixel_and_hopeless_pixel() -> None:
    """The largest density costs -1.394 nats; the floor caps a pixel at 27.63 and kills its gradient."""
    image = torch.zeros(1, 3, 1, 1)
    assert float(mixture(image, image[None], torch.zeros(1, 1, 1, 1), 0.1).nll()) == pytest.approx(-1.394, abs=1e-3)
    far = torch.full((1, 1, 3, 1, 1), 5.0)
    found = mixture(image, far, torch.zeros(1, 1, 1, 1), 0.1)
    assert float(found.nll()) == pytest.approx(27.63, abs=0.01)
    assert float(image_gradients(image, far, found, 0.1).colours.abs().max()) < 1e-6


def test_gradient_with_respect_to_logits_is_autograds() -> None:
    torch.manual_seed(0)
    image, colours = torch.rand(2, 3, 4, 4), torch.rand(2, 3, 3, 4, 4)
    logits = torch.randn(2, 3, 4, 4, requires_grad=True)
    found = mixture(image, colours, logits, 0.1)
    (wanted,) = torch.autograd.grad(found.nll().sum(), logits)
    assert_near(image_gradients(image, colours, found, 0.1).logits.detach(), wanted)


def test_gradients_with_respect_to_the_posterior_are_autograds() -> None:
    torch.manual_seed(0)
    mean, eps, slope, *prior = torch.randn(5, 2, 3, 4)
    raw = torch.randn(2, 3, 4)
    raw[0, 0, 0] = 90.0  # above the clamp: no gradient
    posterior = RawGaussian(mean.requires_grad_(), raw.requires_grad_())
    loss = (posterior.sample(eps) * slope).sum() + 0.3 * kl(posterior, RawGaussian(*prior)).sum()
    wanted = torch.autograd.grad(loss, [mean, raw])
    for found, expected in zip(
        parameter_gradients(posterior, RawGaussian(*prior), eps, slope, 0.3), wanted, strict=True
    ):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_norms_add_epsilon_to_the_unbiased_deviation() -> None:
    """Rows that are scaled by 1e-4, 1e-6 and 0 show where epsilon stands."""
    norm = ImageNorm(3)
    norm.load_state_dict({"scale": array("ln/gamma2d"), "shift": array("ln/beta2d")})
    for found, wanted in zip(norm(array("ln/x2d")), array("ln/y2d"), strict=True):
        assert_near(found, wanted)
    vector = VectorNorm(4)
    vector.load_state_dict({"scale": array("ln/scale1d"), "shift": array("ln/center1d")})
    for found, wanted in zip(vector(array("ln/x1d")), array("ln/y1d"), strict=True):
        assert_near(found, wanted)


def test_coordinates_are_x_then_y() -> None:
    assert_near(coordinate_maps(8), array("coords/8"), 1e-6)


def test_decoder() -> None:
    decoder = Decoder(8, 8)
    for i, conv in enumerate([decoder.first, *decoder.others]):
        name = f"w/decode_net.broadcast_net.conv_layers.{i}"
        conv.load_state_dict({"weight": array(f"{name}.weight"), "bias": array(f"{name}.bias")})
    found = decoder(array("dec/z"), decoder.prepare())
    assert_near(found.colours, array("dec/colors"), 1e-3)
    assert_near(found.logits, array("dec/mask_logits")[:, 0], 1e-3)


def test_decoders_gradient_is_autograds() -> None:
    torch.manual_seed(0)
    decoder, slot = Decoder(6, 9), torch.randn(3, 6, requires_grad=True)
    weights = decoder.prepare()
    found = decoder(slot, weights)
    to_colours, to_logits = torch.randn_like(found.colours), torch.randn_like(found.logits)
    (wanted,) = torch.autograd.grad([found.colours, found.logits], slot, [to_colours, to_logits])
    assert_near(decoder.pull_back(found, to_colours, to_logits, weights), wanted)


@pytest.mark.parametrize(("kernel", "size"), [(3, 3), (3, 8), (5, 5), (5, 6), (5, 16)])
def test_tiled_convolution_is_the_plain_one(kernel: int, size: int) -> None:
    torch.manual_seed(0)
    conv, vector = TiledConv(4, 3, kernel, size), torch.randn(2, 4)
    tiled = torch.cat(
        [vector[..., None, None].expand(-1, -1, size, size), coordinate_maps(size).expand(2, -1, -1, -1)], 1
    )
    wanted = F.conv2d(tiled, conv.weight, conv.bias, padding=kernel // 2)
    assert_near(conv(vector, conv.prepare()).transpose(1, 2).unflatten(2, (size, size)), wanted)


def test_tiled_convolution_refuses_images_smaller_than_its_kernel() -> None:
    with pytest.raises(ValueError, match="4 px is smaller than the kernel of 5"):
        TiledConv(4, 3, 5, 4)


def test_pooled_elu() -> None:
    x = torch.randn(2, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(_PooledElu.apply(x), F.elu(x).mean((2, 3)))
    assert torch.autograd.gradcheck(_PooledElu.apply, x)


def test_a_second_derivative_of_the_pooled_elu_is_refused() -> None:
    x = torch.randn(2, 3, 4, 4, requires_grad=True)
    pooled = (_PooledElu.apply(x) ** 3).sum()
    (first,) = torch.autograd.grad(pooled, x, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.square().sum().backward()


@pytest.mark.parametrize(
    ("name", "frames", "later", "weighting"),
    [
        ("train5_r2_segment", 5, 2, "segment"),
        ("train5_r1_linear", 5, 1, "linear"),
        ("eval20_r2_segment", 20, 2, "segment"),
        ("tiny3_r2_segment", 3, 2, "segment"),
    ],
)
def test_plan(name: str, frames: int, later: int, weighting: str) -> None:
    plan = Plan(4, later, weighting)  # type: ignore[arg-type]
    steps = plan.steps(frames)
    assert [int(step.kind == "dynamics") for step in steps] == ARRAYS[f"sched/{name}_kind"].tolist()
    assert [step.weight for step in steps] == pytest.approx(ARRAYS[f"sched/{name}_weight"].tolist())
    last = [max(i for i, step in enumerate(steps) if step.frame == frame) for frame in range(frames)]
    assert last == ARRAYS[f"sched/{name}_readout"].tolist()
    # in two chunks
    chunks = plan.steps(2) + plan.steps(frames - 2, before=2)
    assert [(step.kind, step.weight) for step in chunks] == [(step.kind, step.weight) for step in steps]


@pytest.mark.parametrize("name", sorted({n.removesuffix("_kind") for n in ARRAYS.files if n.endswith("_kind")}))
def test_published_schedules(name: str) -> None:
    """The name of each array gives frames, refinements per frame, weighting, and a cap."""
    words = re.fullmatch(r"sched/[a-z]+(\d+)_r(\d+)_(?:(segment|linear)|capped_at_(\d+)_frames)", name)
    assert words is not None
    frames, later, weighting, cap = words.groups()
    found = listed("rprp", 4, int(later), int(frames), weighting or "segment", None if cap is None else int(cap))  # type: ignore[arg-type]
    assert [int(kind == "dynamics") for kind in found.kinds] == ARRAYS[f"{name}_kind"].tolist()
    assert found.weights == pytest.approx(ARRAYS[f"{name}_weight"].tolist())
    if f"{name}_readout" in ARRAYS:
        assert found.readout == ARRAYS[f"{name}_readout"].tolist()


def test_a_capped_schedule_reads_the_last_frame_after_its_last_step() -> None:
    assert listed("rprp", 4, 2, 5, "segment", available=3).readout == [3, 6, 15]


R, D = "refine", "dynamics"


def test_single_step_physics_predicts_to_the_end() -> None:
    """op3.md section 6: s refinements, then dynamics; the length is that of the list."""
    found = listed("single_step_physics", 4, 2, 7, "linear")
    assert found.kinds == [R, R, R, R, D, D, D]
    assert found.weights == [1, 2, 3, 4, 5, 6, 7]
    assert found.readout == [3, 4, 5, 6]
    assert listed("single_step_physics", 4, 2, 7, "segment", available=2).kinds == [R, R, R, R, D, R, R]
    assert listed("single_step_physics", 4, 2, 3, "segment").kinds == [R, R, R]


def test_curriculum_predicts_n_frames_and_refines_once() -> None:
    found = listed("curriculum", 2, 9, 99, "segment", predictions=3)
    assert found.kinds == [R, R, D, D, D, R]
    assert found.weights == [0.5, 1, 1, 1, 1, 1]
    assert found.readout == [1, 2, 3, 5]
    assert listed("curriculum", 2, 9, 99, "segment", available=2, predictions=3).kinds == [R, R, D, R, R, R]


def test_frames_that_a_schedule_does_not_reach_are_predicted_and_count_nothing() -> None:
    steps = Plan(1, 2, "linear", "curriculum").training_steps(4, predictions=1)
    assert [(step.kind, step.frame, step.weight) for step in steps] == [
        (R, 0, 1.0),
        (D, 1, 2.0),
        (R, 1, 3.0),
        (D, 2, 0.0),
        (D, 3, 0.0),
    ]


@pytest.mark.parametrize("schedule", ["rprp", "single_step_physics", "curriculum"])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_every_frame_of_a_clip_has_a_step(schedule: str, frames: int) -> None:
    for predictions in (1, 3, 9):
        steps = Plan(2, 1, "segment", schedule).training_steps(frames, predictions)  # type: ignore[arg-type]
        assert sorted({step.frame for step in steps}) == list(range(frames))


def test_without_later_refinements_a_clip_is_predicted() -> None:
    steps = Plan(2, 0, "segment").steps(3)
    assert [(step.kind, step.frame) for step in steps] == [
        ("refine", 0),
        ("refine", 0),
        ("dynamics", 1),
        ("dynamics", 2),
    ]


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_parameter_counts() -> None:
    model = Op3()
    net, dynamics = model.refinement, model.dynamics
    norms = [net.norm_masks, net.norm_density, net.norm_others, net.norm_colours]
    assert [count(norm) for norm in norms] == [2, 2, 2, 6]
    assert count(net.norm_mean) + count(net.norm_raw) == 256
    assert count(net.convs) == 90_528
    assert count(net.compress) == 8_320
    assert count(net.lstm) == 295_936
    assert count(net) == 411_296 + 12 + 256
    parts = (dynamics.inertia, dynamics.pair, dynamics.effect, dynamics.attention, dynamics.merge)
    assert [count(part) for part in parts] == [33_024, 98_688, 20_640, 16_641, 37_120]
    assert count(dynamics) == 280_417
    assert count(model.decoder) == 184_132
    assert count(model) == 876_305


NAMES = {
    "initial_deter_state": "start_deterministic",
    "initial_lambdas1": "start_mean",
    "initial_lambdas2": "start_raw",
    "refinement_net.conv_layers.": "refinement.convs.",
    "refinement_net.fc_layers.0.": "refinement.compress.",
    "refinement_net.lstm.": "refinement.lstm.",
    "refinement_net.last_fc.": "refinement.to_mean.",
    "refinement_net.last_fc2.": "refinement.to_raw.",
    "dynamics_net.inertia_encoder.": "dynamics.inertia.",
    "dynamics_net.pairwise_encoder_network.": "dynamics.pair.",
    "dynamics_net.interaction_effect_network.": "dynamics.effect.",
    "dynamics_net.interaction_attention_network.": "dynamics.attention.",
    "dynamics_net.final_merge_network.": "dynamics.merge.",
    "dynamics_net.det_output.": "dynamics.to_deterministic.",
    "dynamics_net.lambdas1_output.": "dynamics.to_mean.",
    "dynamics_net.lambdas2_output.": "dynamics.to_raw.",
    "decode_net.broadcast_net.conv_layers.0.": "decoder.first.",
    **{f"decode_net.broadcast_net.conv_layers.{i + 1}.": f"decoder.others.{i}." for i in range(4)},
    "layer_norms_2d.0.": "refinement.norm_masks.",
    "layer_norms_2d.1.": "refinement.norm_density.",
    "layer_norms_2d.2.": "refinement.norm_others.",
    "layer_norms_2d.3.": "refinement.norm_colours.",
    "layer_norms_1d.0.": "refinement.norm_mean.",
    "layer_norms_1d.1.": "refinement.norm_raw.",
}
"""Beginnings of the published names of weights -> of ours."""

ENDS = {"fcs.0.": "0.", "last_fc.": "2.", "_l0": "", "gamma": "scale", "beta": "shift", "scale_param": "scale"}


def own_name(published: str) -> str:
    """Our name of a published weight."""
    start = max((start for start in NAMES if published.startswith(start)), key=len)
    rest = published.removeprefix(start)
    for theirs, ours in {**ENDS, "center_param": "shift"}.items():
        rest = rest.replace(theirs, ours)
    return NAMES[start] + rest


def test_all_published_weights_have_a_place() -> None:
    """Names and shapes of the published networks with S = R = 4 and images of 8 x 8."""
    wanted = json.loads((Path(__file__).parent / "fixtures" / "weights.json").read_text())
    found = {name: list(weight.shape) for name, weight in Op3(8, 3, 4, 4, 128).named_parameters()}
    assert found == {own_name(name): shape for name, shape in wanted.items()}
    assert len(found) == len(wanted) == 73


def test_initial_weights() -> None:
    torch.manual_seed(0)
    model = Op3()
    assert float(model.start_mean.detach().std()) == pytest.approx(1 / 8, rel=0.3)
    assert float(model.refinement.compress.weight.abs().max()) <= 1e-4
    first, last = model.dynamics.pair[0], model.dynamics.pair[2]
    assert isinstance(first, nn.Linear)
    assert isinstance(last, nn.Linear)
    assert float(first.weight.abs().max()) == pytest.approx(1 / 16, rel=0.01)  # 256 outputs
    assert torch.equal(first.bias, torch.full((256,), 0.1))
    assert float(last.weight.abs().max()) <= 3e-3
    for conv in (model.decoder.first, *model.decoder.others, *model.refinement.convs):
        fans = conv.weight[0].numel() + conv.weight[:, 0].numel()
        assert float(conv.weight.abs().max()) == pytest.approx((6 / fans) ** 0.5, rel=0.01)
        assert not conv.bias.any()


def test_a_slot_alone_has_no_effects() -> None:
    """With one slot the gated sum over others is zero; with two it is not, and it follows the slots' order."""
    torch.manual_seed(0)
    dynamics = Dynamics(4, 4)
    slots = torch.randn(1, 3, 8)
    alone, together = dynamics(slots[:, :1]), dynamics(slots)
    assert not torch.allclose(alone.deterministic, together.deterministic[:, :1])
    order = [2, 0, 1]
    turned = dynamics(slots[:, order])
    torch.testing.assert_close(turned.deterministic, together.deterministic[:, order])
    torch.testing.assert_close(turned.stochastic.mean, together.stochastic.mean[:, order])


@pytest.mark.parametrize("width", [6, 7])
def test_pairs_of_columns_give_the_plain_convolution(width: int) -> None:
    conv = torch.nn.Conv2d(3, 4, 5, padding=2).double()
    x = torch.randn(2, 3, 5, width, dtype=torch.float64, requires_grad=True)
    weigh = torch.randn(2, 4, 5, width, dtype=torch.float64)
    found, expected = conv_by_pairs(x, conv), conv(x)
    torch.testing.assert_close(found, expected)
    of = [x, conv.weight, conv.bias]
    for mine, plain in zip(*(torch.autograd.grad((y * weigh).sum(), of) for y in (found, expected)), strict=True):
        torch.testing.assert_close(mine, plain)

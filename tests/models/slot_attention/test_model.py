"""Slot Attention against the published arrays, a second implementation, and what its README promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.models.slot_attention import SlotAttention
from apex_lab.models.slot_attention.model import (
    Encoder,
    Grouping,
    SameConv2d,
    SameConvTranspose2d,
    position_grid,
)
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Context, Noise, Scene
from apex_lab.training.schedules import WarmupDecay
from tests.reference import slot_attention as naive

SIDE = 32
VARIANTS = ("released", "strided", "small")


@pytest.fixture(scope="module")
def published() -> dict[str, Tensor]:
    with np.load(Path(__file__).parent / "fixtures" / "published.npz", allow_pickle=False) as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays}


def tiny(variant: str = "released", **changes: object) -> SlotAttention:
    torch.manual_seed(0)
    model = SlotAttention(image_size=SIDE, variant=variant, features=8, slot_size=12, hidden=16, **changes)
    for parameter in model.parameters():  # no bias stays zero, no scale one: each could be missing unnoticed
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model


def video(b: int = 2, t: int = 3, side: int = SIDE) -> Tensor:
    return torch.rand(b, t, 3, side, side, generator=torch.Generator().manual_seed(1))


class Given(Noise):
    """Noise from a tensor."""

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def normal(self, like: Tensor) -> Tensor:
        return self.values.reshape(like.shape)


def evaluate(model: SlotAttention, x: Tensor, videos: list[int] | None = None, first: int = 0) -> Scene:
    """A scene with the noise of each video, which is counted from 0 where it has no number."""
    with torch.no_grad():
        return model.eval()(x, Context(noise=VideoNoise(0, videos or range(len(x)), first)))


def close(found: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * expected.detach().abs().max().item())


# --- published arrays ---


@pytest.mark.parametrize(("height", "width"), [(4, 6), (8, 8)])
def test_position_grid(published: dict[str, Tensor], height: int, width: int) -> None:
    close(position_grid(height, width, torch.zeros(())), published[f"grid/{height}x{width}"])


@pytest.fixture
def grouping(published: dict[str, Tensor]) -> Grouping:
    grouping = Grouping(features=6, slot_size=8, hidden=16)
    names = {
        "slots_mu": "mu",
        "slots_log_sigma": "log_sigma",
        "norm_input": "norm_tokens",
        "norm_pre_ff": "norm_mlp",
    }
    weights = {}
    for key, value in published.items():
        if key.startswith("w/"):
            module, *rest = key[2:].split(".")
            weights[".".join([names.get(module, module), *rest])] = value.squeeze()
    grouping.load_state_dict(weights)
    return grouping


def test_slots_start_from_the_shared_gaussian(published: dict[str, Tensor], grouping: Grouping) -> None:
    close(grouping.start(published["init/noise"]), published["init/slots"])


def test_an_iteration(published: dict[str, Tensor], grouping: Grouping) -> None:
    tokens, slots = grouping.norm_tokens(published["step/inputs"]), published["init/slots"]
    close(grouping.to_k(tokens), published["step/eps1e-3/k"])
    close(grouping.to_v(tokens), published["step/eps1e-3/v"])
    close(grouping.to_q(grouping.norm_slots(slots)), published["step/eps1e-3/q"])
    attention = grouping.attend(slots, tokens)
    close(attention.transpose(1, 2), published["step/eps1e-3/attn"])
    close(grouping.update(slots, attention, tokens), published["step/eps1e-3/slots_out"])
    torch.testing.assert_close(attention.sum(1), torch.ones(2, 24))


def test_permuting_the_slots_permutes_the_result(published: dict[str, Tensor], grouping: Grouping) -> None:
    tokens, noise, order = published["step/inputs"], published["init/noise"], published["step/permutation"].long()
    close(grouping(tokens, noise[:, order], 3), grouping(tokens, noise, 3)[:, order])


def test_tokens_are_normalised_one_by_one(published: dict[str, Tensor]) -> None:
    encoder = Encoder(6, (1,), "pytorch")
    names = {"pos": "position.linear", "ln": "norm", "fc1": "mlp.0", "fc2": "mlp.2"}
    weights = {k[4:].rsplit("_", 1)[0]: k for k in published if k.startswith("enc/") and k.endswith(("weight", "bias"))}
    assert set(weights) == set(names)
    for name, module in names.items():
        for kind in ("weight", "bias"):
            encoder.get_parameter(f"{module}.{kind}").data.copy_(published[f"enc/{name}_{kind}"])
    found = encoder.tokens(published["enc/features"])
    close(found, published["enc/tokens_eps1e-3"])
    assert (found - published["enc/WRONG_tokens_groupnorm"]).abs().max() > 0.01
    # PyTorch's epsilon, which other implementations have, gives other numbers (slot_attention.md section 8)
    encoder.norm.eps = 1e-5
    with np.load(Path(__file__).parent / "fixtures" / "epsilon.npz", allow_pickle=False) as arrays:
        others = torch.from_numpy(arrays["enc/tokens_eps1e-5"])
    close(encoder.tokens(published["enc/features"]), others)
    assert (found - others).abs().max() > 1e-4


def test_a_model_in_double_precision_has_a_scene_in_it() -> None:
    scene = evaluate(tiny().double(), video().double())
    for name in ("masks", "presence", "appearance", "reconstruction"):
        assert getattr(scene, name).dtype == torch.float64, name


def test_learning_rate(published: dict[str, Tensor]) -> None:
    schedule = WarmupDecay(warmup=10_000, half_life=100_000)
    found = torch.tensor([4e-4 * schedule(int(step)) for step in published["lr/step"]])
    close(found, published["lr/lr_decay_from_zero"])
    assert (found - published["lr/lr_decay_after_warmup"]).abs().max() > 1e-5


def test_learning_rate_by_number() -> None:
    schedule = WarmupDecay(warmup=10_000, half_life=100_000)
    assert schedule(0) == 0
    assert 4e-4 * schedule(10_000) == pytest.approx(3.732e-4, rel=1e-3)
    assert 4e-4 * schedule(400_000) == pytest.approx(2.5e-5)
    assert WarmupDecay(warmup=0, half_life=10)(0) == 1


# --- sizes and starting values ---


def test_parameter_counts() -> None:
    def count(module: torch.nn.Module) -> int:
        return sum(p.numel() for p in module.parameters())

    model = SlotAttention()
    assert count(model.encoder.convs) == 312_256
    assert count(model.encoder.position) == 320
    assert count(model.encoder.norm) + count(model.encoder.mlp) == 8_448
    assert count(model.grouping) == 54_336
    assert count(model.grouping.gru) == 24_960
    assert count(model.decoder.position) == 320
    assert count(model.decoder) - count(model.decoder.position) == 514_628
    assert count(model) == 890_308
    assert count(SlotAttention(variant="strided")) == 890_308
    small = SlotAttention(image_size=64, variant="small")
    assert [count(part) for part in (small.encoder, small.grouping, small.decoder)] == [81_664, 50_176, 103_972]
    assert (model.decoder.grid, SlotAttention(image_size=64).decoder.grid, small.decoder.grid) == (8, 4, 64)


@torch.no_grad()
def test_starting_values_are_those_of_keras() -> None:
    torch.manual_seed(0)
    model = SlotAttention()
    grouping = model.grouping
    limits = {
        model.encoder.convs[1].weight: (6 / (2 * 64 * 25)) ** 0.5,
        model.decoder.first.weight: (6 / (2 * 64 * 25)) ** 0.5,
        model.encoder.position.linear.weight: (6 / 68) ** 0.5,
        grouping.gru.weight_ih: (6 / 256) ** 0.5,
        grouping.mu: (6 / 65) ** 0.5,
        grouping.log_sigma: (6 / 65) ** 0.5,
    }
    for weight, limit in limits.items():
        assert 0.9 * limit < weight.abs().max() <= limit
        assert weight.std() == pytest.approx(limit / 3**0.5, rel=0.2)
    torch.testing.assert_close(grouping.gru.weight_hh.T @ grouping.gru.weight_hh, torch.eye(64), atol=1e-5, rtol=0)
    assert all((p == 0).all() for name, p in model.named_parameters() if "bias" in name)


# --- against the second implementation ---


@pytest.mark.parametrize("variant", VARIANTS)
def test_scene_loss_and_gradients_of_the_naive_twin(variant: str) -> None:
    model, x = tiny(variant).double(), video().double()
    eps = torch.randn(2, 3, 5, 12, dtype=torch.float64)
    scene = model(x, Context(noise=Given(eps)))
    weights = {name: p.detach().clone().requires_grad_() for name, p in model.named_parameters()}
    masks, slots, loss = naive.explain(x, eps, weights, variant)
    torch.testing.assert_close(scene.masks, masks)
    torch.testing.assert_close(scene.appearance, slots)
    torch.testing.assert_close(scene.terms["mse"], loss)
    scene.terms["mse"].sum().backward()
    loss.sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, weights[name].grad, rtol=1e-7, atol=1e-12)


def test_more_slots_and_iterations_at_call_time() -> None:
    model, x = tiny().double(), video(1, 1).double()
    model.slots, model.iterations = 7, 5
    eps = torch.randn(1, 1, 7, 12, dtype=torch.float64)
    scene = model(x, Context(noise=Given(eps)))
    masks, _, _ = naive.explain(x, eps, dict(model.named_parameters()), "released", iterations=5)
    torch.testing.assert_close(scene.masks, masks)
    assert scene.ids.shape == (1, 1, 7)
    assert scene.background.tolist() == [False] * 7


# --- the convention of TensorFlow ---


def test_tensorflow_s_transposed_convolution_by_hand() -> None:
    """Pixel i of the input is spread over the pixels 2 i - 1 to 2 i + 3, of which those inside the image stay."""
    conv = SameConvTranspose2d(1, 1, 5, 2, "tensorflow")
    torch.nn.init.zeros_(conv.bias)
    x, expected = torch.zeros(1, 1, 4, 4), torch.zeros(8, 8)
    for row, column in ((0, 3), (2, 1)):
        x[0, 0, row, column] = 1
        for i in range(5):
            for j in range(5):
                r, c = 2 * row - 1 + i, 2 * column - 1 + j
                if 0 <= r < 8 and 0 <= c < 8:
                    expected[r, c] += conv.weight[0, 0, i, j].item()
    torch.testing.assert_close(conv(x)[0, 0], expected)


def test_tensorflow_s_strided_convolution_by_hand() -> None:
    """Pixel i of the output sees the pixels 2 i - 1 to 2 i + 3 of the input."""
    conv = SameConv2d(1, 1, 5, 2, "tensorflow")
    torch.nn.init.zeros_(conv.bias)
    x, weight = torch.rand(1, 1, 8, 8), conv.weight.detach()[0, 0]
    padded = F.pad(x, (1, 2, 1, 2))[0, 0]
    expected = [[(padded[2 * i :, 2 * j :][:5, :5] * weight).sum() for j in range(4)] for i in range(4)]
    torch.testing.assert_close(conv(x)[0, 0], torch.tensor(expected))


@pytest.mark.parametrize("kind", [SameConv2d, SameConvTranspose2d])
def test_conventions_differ_by_a_shift_at_stride_2_only(kind: type[SameConv2d] | type[SameConvTranspose2d]) -> None:
    x = torch.rand(1, 2, 16, 16)
    for stride in (1, 2):
        ours, theirs = kind(2, 3, 5, stride, "pytorch"), kind(2, 3, 5, stride, "tensorflow")
        theirs.load_state_dict(ours.state_dict())
        assert ours(x).shape == theirs(x).shape
        assert torch.equal(ours(x), theirs(x)) == (stride == 1)
    if kind is SameConvTranspose2d:
        torch.testing.assert_close(ours(x)[..., :-1, :-1], theirs(x)[..., 1:, 1:])


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_model_with_tensorflow_s_padding(variant: str) -> None:
    scene = evaluate(tiny(variant, padding="tensorflow"), video())
    assert scene.masks.shape == (2, 3, 5, SIDE, SIDE)
    assert torch.equal(scene.masks, evaluate(tiny(variant), video()).masks) == (variant == "small")


# --- the contract ---


def test_fields_of_a_scene() -> None:
    model = tiny().eval()
    with torch.no_grad():
        scene = model(video(), Context(detail=True))
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 3, SIDE, SIDE))
    assert scene.means is not None
    assert scene.means.shape == (2, 3, 5, 3, SIDE, SIDE)
    assert scene.ids[1, 2].tolist() == [0, 1, 2, 3, 4]
    assert (scene.presence == 1).all()
    assert not scene.background.any()
    assert scene.state is None
    assert scene.windows is None
    assert (scene.reconstruction >= 0).all()
    assert (scene.reconstruction <= 1).all()
    assert 0 <= scene.diagnostics["slots_in_use"] <= 5


def test_the_loss_is_in_units_from_minus_one_to_one() -> None:
    """A decoder that draws grey, 0, makes the mean of (2 x - 1)^2, summed over frames."""
    model, x = tiny(), video()
    torch.nn.init.zeros_(model.decoder.head.weight)
    torch.nn.init.zeros_(model.decoder.head.bias)
    scene = evaluate(model, x)
    torch.testing.assert_close(scene.terms["mse"], (2 * x - 1).square().mean(dim=(2, 3, 4)).sum(dim=1))
    assert (scene.reconstruction == 0.5).all()


def test_input_range(published: dict[str, Tensor]) -> None:
    torch.testing.assert_close(2 * (published["range/uint8"].float() / 255) - 1, published["range/float"])


def test_chunks_give_what_whole_videos_give() -> None:
    model, x = tiny(), video(2, 7)
    whole = evaluate(model, x)
    parts = [evaluate(model, x[:, :3]), evaluate(model, x[:, 3:], first=3)]
    torch.testing.assert_close(torch.cat([part.masks for part in parts], 1), whole.masks)
    torch.testing.assert_close(sum(part.terms["mse"] for part in parts), whole.terms["mse"])


def test_a_video_s_scene_is_the_same_beside_other_videos() -> None:
    model, x = tiny(), video(3)
    together, alone = evaluate(model, x), evaluate(model, x[1:2], videos=[1])
    torch.testing.assert_close(together.masks[1:2], alone.masks)
    torch.testing.assert_close(together.terms["mse"][1:2], alone.terms["mse"])


def test_slots_start_from_noise_in_evaluation_too() -> None:
    model, x = tiny(), video()
    assert torch.equal(evaluate(model, x).masks, evaluate(model, x).masks)
    assert not torch.equal(evaluate(model, x).masks, evaluate(model, x, videos=[7, 8]).masks)


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_reach_all_parameters(variant: str) -> None:
    model = tiny(variant)
    model(video(), Context()).terms["mse"].mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_parts_on_a_cpu_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    model, x = tiny(), video()
    whole = evaluate(model, x)
    monkeypatch.setattr("apex_lab.nn.splitting.CACHED", 3 * 4 * model.decoder.largest)
    torch.testing.assert_close(evaluate(model, x).masks, whole.masks)


def test_half_precision() -> None:
    model, x = tiny(), video()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scene = model(x, Context())
    scene.terms["mse"].mean().backward()
    assert scene.masks.dtype == scene.terms["mse"].dtype == torch.float32
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 3, SIDE, SIDE))


def test_a_slot_without_tokens_gets_no_nan() -> None:
    grouping = Grouping(4, 6, 8)
    attention = torch.zeros(1, 3, 10)
    attention[:, 0] = 1
    assert grouping.update(torch.randn(1, 3, 6), attention, torch.randn(1, 10, 4)).isfinite().all()


def test_other_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"image_size=40 must be a multiple of 16"):
        SlotAttention(image_size=40)
    with pytest.raises(ValueError, match=r"built for \(32, 32\)"):
        tiny()(video(side=48), Context())

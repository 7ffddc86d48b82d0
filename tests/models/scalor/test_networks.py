"""Every network of SCALOR against outputs of the published implementation, and its number of parameters."""

from __future__ import annotations

import pytest
import torch

from apex_lab.models.scalor import Scalor
from apex_lab.models.scalor.background import Background
from apex_lab.models.scalor.discovery import Discovery
from apex_lab.models.scalor.encoder import ImageEncoder, PeepholeConvLSTM, VideoEncoder
from apex_lab.models.scalor.glimpses import GlimpseDecoder, GlimpseEncoder
from apex_lab.models.scalor.propagation import Propagation
from apex_lab.models.scalor.slots import Objects
from apex_lab.models.scalor.windows import AnchoredSize
from tests.models.scalor.fixture import array, det, parameters_of, set_weights

ANCHORED = AnchoredSize()


def close(got: torch.Tensor, want: torch.Tensor) -> None:
    torch.testing.assert_close(got, want, rtol=0, atol=1e-3 * max(1.0, float(want.abs().max())))


def check_count(name: str, count: int) -> None:
    assert count == int(array(f"net/{name}/nparams"))


def test_image_encoder() -> None:
    network = ImageEncoder(128, 8)
    check_count("img_encoder_128_g8", parameters_of(network))
    set_weights([*network.stack.parameters(), *network.lateral.parameters(), *network.fuse.parameters()])
    close(network(det(1, 3, 128, 128)), array("net/img_encoder_128_g8/out0"))


def test_glimpse_encoder() -> None:
    network = GlimpseEncoder(64, 64)
    check_count("glimpse_encoder_64", parameters_of(network))
    set_weights([*network.stack.parameters(), *network.head.parameters()])
    mean, raw = network.encode(det(2, 3, 64, 64)).chunk(2, dim=-1)
    close(mean, array("net/glimpse_encoder_64/out0"))
    close(raw, array("net/glimpse_encoder_64/out1"))


def test_glimpse_decoder() -> None:
    network = GlimpseDecoder(64, 64, deep_heads=True)
    check_count("glimpse_decoder_64", parameters_of(network))
    set_weights([*network.trunk.parameters(), *network.colour.parameters(), *network.alpha.parameters()])
    drawn = network(det(1, 64) - 0.5)
    close(drawn[:, :3], array("net/glimpse_decoder_64/out0"))
    close(drawn[:, 3:], array("net/glimpse_decoder_64/out1"))


@pytest.mark.parametrize("size", [16, 32, 64])
def test_glimpse_decoder_runs_its_heads_together(size: int) -> None:
    for deep in (False, True):
        network = GlimpseDecoder(size, 64, deep)
        what = torch.randn(3, 64, generator=torch.Generator().manual_seed(0))
        trunk = network.trunk(what[..., None, None])
        apart = torch.sigmoid(torch.cat([network.colour(trunk), network.alpha(trunk)], dim=1))
        torch.testing.assert_close(network(what), apart)
        assert apart.shape == (3, 4, size, size)


@pytest.mark.parametrize("keep", [True, False])
def test_gradients_of_glimpses_are_those_of_the_layers(keep: bool) -> None:
    network = GlimpseDecoder(64, 8, deep_heads=True).double()
    generator = torch.Generator().manual_seed(0)
    what = torch.randn(3, 7, 8, generator=generator, dtype=torch.float64)  # 21 glimpses: several parts on a CPU
    on_drawn = torch.randn(3, 7, 4, 64, 64, generator=generator, dtype=torch.float64)
    found = []
    for plain in (True, False):
        code = what.clone().requires_grad_()
        if plain:
            trunk = network.trunk(code.flatten(0, 1)[..., None, None])
            drawn = torch.sigmoid(torch.cat([network.colour(trunk), network.alpha(trunk)], dim=1)).unflatten(0, (3, 7))
        else:
            drawn = network(code, keep=keep)
        found.append((drawn.detach(), *torch.autograd.grad(drawn, [code, *network.parameters()], on_drawn)))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-11 * float(a.abs().max()))


def test_background_encoder() -> None:
    network = Background(128, 10, "strong").encoder
    check_count("bg_encoder_128", parameters_of(network))
    set_weights(network.parameters())
    mean, raw = network(det(1, 4, 128, 128)).flatten(1).chunk(2, dim=-1)
    close(mean, array("net/bg_encoder_128/out0"))
    close(raw, array("net/bg_encoder_128/out1"))


def test_background_decoder() -> None:
    network = Background(128, 10, "strong")
    check_count("bg_decoder_128", parameters_of(network.decoder))
    set_weights(network.decoder.parameters())
    close(network.draw(2 * det(1, 10) - 1)[..., ::4, ::4], array("net/bg_decoder_128/out0_every4"))


def test_mask_encoder() -> None:
    network = Discovery(128, 8, ANCHORED, deep_heads=True).mask_encoder
    check_count("mask_encoder_128_g8", parameters_of(network))
    set_weights(network.parameters())
    close(network(det(1, 1, 128, 128)), array("net/mask_encoder_128_g8/out0"))


def test_discovery_fusion_and_where_head() -> None:
    network = Discovery(128, 8, ANCHORED, deep_heads=True)
    check_count("discovery_cat_encoder", parameters_of(network.fusion))
    set_weights(network.fusion.parameters())
    close(network.fusion(det(1, 96, 8, 8)), array("net/discovery_cat_encoder/out0"))
    check_count("discovery_where_head_128", parameters_of(network.where))
    set_weights(network.where.parameters())
    close(network.where(det(1, 64, 8, 8)), array("net/discovery_where_head_128/out0"))


def test_propagation_attention_encoder() -> None:
    network = Propagation(8, 64, ANCHORED, 0.6)
    check_count("propagation_attention_encoder_g8", parameters_of(network.attention, network.attention_code))
    set_weights([*network.attention.parameters(), *network.attention_code.parameters()])
    close(
        network.attention_code(network.attention(det(3, 64, 4, 4)).flatten(1)),
        array("net/propagation_attention_encoder_g8/out0"),
    )


def _set_conv_lstm(layers: list[PeepholeConvLSTM]) -> None:
    tensors, targets = [], []
    for layer in layers:
        peepholes = [torch.nn.Parameter(torch.zeros(1, *layer.peephole.shape[1:])) for _ in range(3)]
        targets.append((layer, peepholes))
        tensors += [*peepholes, *layer.from_input.parameters(), *layer.from_hidden.parameters()]
    set_weights(tensors)
    with torch.no_grad():
        for layer, peepholes in targets:
            layer.peephole.copy_(torch.cat(peepholes))


def test_conv_lstm_of_two_layers() -> None:
    network = VideoEncoder(128, 8)
    check_count("conv_lstm_2layer_g8", parameters_of(network.memory))
    _set_conv_lstm(list(network.memory))
    features = det(1, 3, 64, 8, 8)
    for layer in network.memory:
        features, _ = layer(features, None)
    close(features, array("net/conv_lstm_2layer_g8/out0"))


def test_conv_lstm_step_peeps_at_the_old_cell() -> None:
    layer = PeepholeConvLSTM(4, 5)
    with torch.no_grad():
        layer.peephole.copy_(torch.cat([array(f"convlstm_cell/Wc{gate}") for gate in "ifo"]))
    driven = torch.nn.functional.conv2d(
        array("convlstm_cell/x"), array("convlstm_cell/Wx"), array("convlstm_cell/bx"), padding=1
    )
    with torch.no_grad():
        layer.from_hidden.weight.copy_(array("convlstm_cell/Wh"))
    h, c = layer.step(driven, array("convlstm_cell/h"), array("convlstm_cell/c"))
    torch.testing.assert_close(h, array("convlstm_cell/h_next"), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(c, array("convlstm_cell/c_next"), rtol=1e-4, atol=1e-5)


def test_propagation_prior() -> None:
    network = Propagation(8, 64, ANCHORED, 0.6).prior
    modules = (network.input, network.rnn, network.what, network.where, network.depth, network.presence)
    set_weights([p for module in modules for p in module.parameters()])
    h, c = det(2, 64) - 0.5, 0.3 * det(2, 64)
    before = Objects(
        what=2 * det(2, 64) - 1,
        where=det(2, 4),
        raw=det(2, 4) - 0.5,
        depth=det(2, 1),
        presence=det(2, 1),
        tracker=torch.zeros(2, 128),
        prior_h=h,
        prior_c=c,
        absence=torch.zeros(2, 1),
    )
    h, c = network.step(Objects(*(x[None] for x in before)))
    close(h[0], array("net/propagation_prior/h"))
    close(c[0], array("net/propagation_prior/c"))
    what, where, depth, presence = network.heads(h[0])
    for name, q in {"what": what, "where": where, "depth": depth}.items():
        close(q.mean, array(f"net/propagation_prior/{name}_mean"))
        close(q.std, array(f"net/propagation_prior/{name}_std"))
    close(presence[:, None], array("net/propagation_prior/pres_prob"))


COUNTS = {
    # image side, G, g: total, image encoder, ConvLSTM, glimpse encoder, glimpse decoder, mask encoder, where, presence
    # and depth heads, attention, background encoder, background decoder (scalor.md section 15)
    (128, 8, 64): (
        5_000_002, 230_624, 614_912, 452_560, 304_084, 155_792, (4_808, 4_353, 2_210), 135_488, 194_276, 2_413_555
    ),
    (128, 4, 64): (
        5_088_834, 333_408, 596_480, 452_560, 304_084, 258_576, (4_808, 4_353, 2_210), 37_184, 194_276, 2_413_555
    ),
    (64, 8, 64): (3_175_570, 95_072, 614_912, 452_560, 302_020, 90_064, (520, 65, 130), 135_488, 128_548, 868_851),
    (64, 8, 32): (2_819_106, 95_072, 614_912, 227_088, 171_028, 90_064, (520, 65, 130), 135_488, 128_548, 868_851),
    (64, 4, 32): (2_833_826, 160_800, 596_480, 227_088, 171_028, 155_792, (520, 65, 130), 37_184, 128_548, 868_851),
}  # fmt: skip


@pytest.mark.parametrize("sizes", COUNTS)
def test_parameters_per_module(sizes: tuple[int, int, int]) -> None:
    image_size, grid, glimpse = sizes
    model = Scalor(image_size, grid, glimpse)
    objects, background = model.objects, model.background
    heads = (objects.discovery.where, objects.discovery.presence, objects.discovery.depth)
    attention = (objects.propagation.attention, objects.propagation.attention_code)
    assert COUNTS[sizes] == (
        parameters_of(model),
        parameters_of(model.encoder.image.stack),
        parameters_of(model.encoder.memory),
        parameters_of(objects.glimpse_encoder),
        parameters_of(objects.glimpse_decoder),
        parameters_of(objects.discovery.mask_encoder),
        tuple(parameters_of(head) for head in heads),
        parameters_of(*attention),
        parameters_of(background.encoder),
        parameters_of(background.decoder),
    )


def test_parameters_that_no_size_changes() -> None:
    model = Scalor(128, 8, 64)
    moved = model.objects.propagation
    assert parameters_of(model.encoder.image.lateral) == 74_112
    assert parameters_of(model.encoder.image.fuse) == 73_920
    assert parameters_of(model.objects.discovery.fusion) == 10_624
    assert parameters_of(moved.tracker_input) == 25_856
    assert parameters_of(moved.tracker) == 99_072
    assert [parameters_of(x) for x in (moved.where, moved.depth, moved.what, moved.gates, moved.presence)] == [
        43_144,
        41_346,
        16_576,
        16_578,
        12_929,
    ]
    assert parameters_of(moved.prior) == 68_299
    assert [parameters_of(x) for x in (moved.prior.input, moved.prior.rnn)] == [9_600, 49_664]
    assert parameters_of(model.background.prior_rnn) == 4_224
    assert parameters_of(model.background.prior_head) == 660


def test_parameters_of_the_weak_background_decoder() -> None:
    assert parameters_of(Background(128, 10, "weak").decoder) == 226_307
    assert parameters_of(Background(64, 10, "weak").decoder) == 123_715


@pytest.mark.parametrize("grid", [4, 8])
def test_small_images_have_the_same_interfaces(grid: int) -> None:
    assert ImageEncoder(32, grid)(det(1, 3, 32, 32)).shape == (1, 64, grid, grid)
    assert Discovery(32, grid, ANCHORED, False).mask_encoder(det(1, 1, 32, 32)).shape == (1, 32, grid, grid)
    for kind in ("strong", "weak"):
        background = Background(32, 10, kind)
        assert background.draw(det(2, 10)).shape == (2, 3, 32, 32)
        assert background.posterior(det(2, 3, 32, 32), det(2, 32, 32)).mean.shape == (2, 10)


def test_refuses_a_grid_that_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"image_size=64 must be 4, 8, 16 or 32 times grid=6"):
        ImageEncoder(64, 6)

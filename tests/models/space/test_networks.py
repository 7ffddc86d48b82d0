"""Architecture: sizes, parameter counts, and what is computed otherwise than written (space.md sections 2-5, 11)."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.models.space import Space
from apex_lab.models.space.background import stick_breaking
from apex_lab.models.space.broadcast import BroadcastDecoder
from apex_lab.models.space.networks import BatchNorm, GlimpseDecoder, GlimpseEncoder, ImageEncoder, factors_for
from apex_lab.scene import Noise
from tests.models.space.common import close, context, published


def count(*modules: nn.Module | Tensor) -> int:
    return sum(
        sum(p.numel() for p in module.parameters()) if isinstance(module, nn.Module) else module.numel()
        for module in modules
    )


@pytest.fixture(scope="module")
def model() -> Space:
    return Space()


def test_parameters_of_the_published_model(model: Space) -> None:
    assert count(model) == 5_308_675
    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == 5_307_651
    fg, bg = model.foreground, model.background
    assert count(fg) == 2_358_191
    heads = (fg.scale, fg.shift, fg.presence, fg.depth)
    assert [count(head) for head in heads] == [516, 516, 129, 258]
    encoder = fg.encoder
    assert [count(part) for part in (encoder.trunk, encoder.lateral, encoder.merge)] == [445_008, 295_680, 295_296]
    assert count(encoder, *heads) == 1_037_403
    assert [count(part) for part in (fg.glimpse_encoder.convs, fg.glimpse_encoder.head)] == [707_552, 16_448]
    decoder = fg.glimpse_decoder
    assert [count(part) for part in (decoder.trunk, decoder.colour, decoder.mask)] == [595_184, 435, 145]
    assert count(fg.boundary_kernel) == 1_024
    assert count(bg) == 2_950_484
    assert count(bg.image_encoder) == 375_296
    assert [count(part) for part in (bg.mask_posterior.cell, bg.mask_posterior.head)] == [41_472, 4_160]
    assert [count(part) for part in (bg.mask_prior.cell, bg.mask_prior.head)] == [25_088, 4_160]
    assert count(bg.mask_decoder) == 2_123_217
    assert count(bg.component_encoder) == 328_448
    assert count(bg.component_decoder) == 37_923
    assert count(bg.component_prior) == 10_432
    starts = [part for r in (bg.mask_posterior, bg.mask_prior) for part in (r.start_hidden, r.start_cell)]
    assert count(bg.start_mask, *starts) == 288


@pytest.mark.parametrize("grid", [4, 16])
def test_parameters_do_not_depend_on_the_grid(grid: int) -> None:
    assert count(Space(grid=grid)) == 5_308_675


def test_parameters_with_a_single_background_component() -> None:
    model = Space(components=1)
    assert count(model) == 7_689_939
    assert count(model.background.component_decoder) == 2_419_187


@pytest.mark.parametrize(("size", "grid"), [(128, 16), (128, 8), (128, 4), (64, 8), (64, 4), (32, 4), (32, 1)])
def test_the_trunk_gives_the_grid(size: int, grid: int) -> None:
    assert ImageEncoder(size, grid)(torch.rand(1, 3, size, size)).shape == (1, 128, grid, grid)


def test_strides_at_128_are_the_published_ones() -> None:
    strides = {
        g: [m.stride[0] for m in ImageEncoder(128, g).trunk.modules() if isinstance(m, nn.Conv2d)] for g in (16, 8, 4)
    }
    assert strides == {16: [2, 2, 2, 1, 1, 1], 8: [2, 2, 2, 1, 2, 1], 4: [2, 2, 2, 2, 2, 1]}


@pytest.mark.parametrize("size", [16, 32])
def test_glimpse_networks_fit_their_size(size: int) -> None:
    assert GlimpseEncoder(size, 32)(torch.rand(2, 3, size, size)).shape == (2, 64)
    mask, colour = GlimpseDecoder(size, 32)(torch.randn(2, 32))
    assert (mask.shape, colour.shape) == ((2, 1, size, size), (2, 3, size, size))


def test_up_sampling_factors() -> None:
    published_ones = [4, 2, 4, 4]
    found = {size: factors_for(size, published_ones) for size in (32, 64, 128, 256)}
    assert found == {32: [4, 2, 2, 2], 64: [4, 2, 4, 2], 128: [4, 2, 4, 4], 256: [4, 4, 4, 4]}


def test_stick_breaking_is_the_published_one() -> None:
    arrays = published()
    taken = arrays["sbp_in"].squeeze(2)
    # the last share is discarded
    close(stick_breaking(taken[:, :-1]), arrays["sbp_out"].squeeze(2))
    close(torch.ones(1, 1, 1, 4, 4), arrays["sbp1_out"])


@pytest.mark.parametrize("training", [True, False])
def test_the_broadcast_decoder_equals_one_that_broadcasts(training: bool) -> None:
    torch.manual_seed(0)
    decoder = BroadcastDecoder(latent=5, image_size=16, width=6).train(training)
    plain = copy.deepcopy(decoder)
    z = torch.randn(4, 5)
    ramp = torch.linspace(-1, 1, 24)
    across, down = ramp.expand(24, 24), ramp[:, None].expand(24, 24)
    maps = torch.cat([z[..., None, None].expand(-1, -1, 24, 24), torch.stack([across, down]).expand(4, -1, -1, -1)], 1)
    expected = torch.sigmoid(plain.head(plain.others(plain.first(maps))))
    found = decoder(z)
    close(found, expected, 1e-5)
    weigh = torch.randn_like(found)
    (found * weigh).sum().backward()
    (expected * weigh).sum().backward()
    for (name, a), b in zip(decoder.named_parameters(), plain.parameters(), strict=True):
        assert a.grad is not None
        assert b.grad is not None
        if not name.endswith("0.bias"):  # BatchNorm takes any bias away: its gradient is rounding alone
            close(a.grad, b.grad, 1e-3)
    for a, b in zip(decoder.buffers(), plain.buffers(), strict=True):
        torch.testing.assert_close(a, b)


def test_the_stack_of_the_broadcast_decoder_is_its_layers() -> None:
    """In training, image by image with gradients written out, against the layers one by one."""
    torch.manual_seed(0)
    decoder = BroadcastDecoder(latent=5, image_size=16, width=6).double()
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    plain = copy.deepcopy(decoder)
    z = torch.randn(4, 5, dtype=torch.float64)
    by_latent, by_place = plain._first(z)
    expected = torch.sigmoid(plain.head(plain.others(F.elu(by_latent[..., None, None] + by_place))))
    found = decoder(z)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    weigh = torch.randn_like(found)
    (found * weigh).sum().backward()
    (expected * weigh).sum().backward()
    for a, b in zip(decoder.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-10, atol=1e-10)
    for a, b in zip(decoder.buffers(), plain.buffers(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def stirred() -> Space:
    """The published sizes, with all weights stirred, in training mode."""
    torch.manual_seed(0)
    model = Space()
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(0.05 * torch.randn_like(parameter))
    return model.train()


class Doubles(Noise):
    """The same numbers in every precision."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(1)

    def normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generator, dtype=torch.float64).to(like)

    def uniform(self, like: Tensor) -> Tensor:
        return torch.rand(like.shape, generator=self.generator, dtype=torch.float64).clamp(1e-3, 1 - 1e-3).to(like)


def test_training_in_single_precision_is_as_exact_as_it_can_be() -> None:
    """Channels-last BatchNorm of PyTorch on a CPU gave errors of the likelihood of 5e-6 to 6e-5 here.

    With four videos it is 6e-7 to 1.1e-6, and 4e-7 to 1.4e-6 with PyTorch's slower CELU.
    """
    model, found = stirred(), []
    video = torch.rand(2, 1, 3, 128, 128, generator=torch.Generator().manual_seed(2))
    for dtype in (torch.float32, torch.float64):
        with torch.no_grad():
            scene = copy.deepcopy(model).to(dtype)(video.to(dtype), context(Doubles()))
        found.append({name: term.double() for name, term in scene.terms.items()})
    single, double = found
    for name, wanted in double.items():
        assert float(((single[name] - wanted) / wanted).abs().max()) < (2e-6 if name == "nll" else 1e-5), name


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_batch_norm_is_pytorchs(layout: torch.memory_format) -> None:
    torch.manual_seed(0)
    mine, theirs = BatchNorm(6).double(), nn.BatchNorm2d(6).double()
    with torch.no_grad():
        mine.weight.normal_()
        mine.bias.normal_()
    theirs.load_state_dict(mine.state_dict())
    inputs = torch.randn(3, 6, 5, 4, dtype=torch.float64)
    results = []
    for norm in (mine, theirs):
        x = inputs.clone().contiguous(memory_format=layout).requires_grad_()
        y = norm(x)
        assert y.is_contiguous(memory_format=layout)
        (y * torch.arange(y.numel(), dtype=y.dtype).view(y.shape).sin()).sum().backward()
        results.append([y, x.grad, norm.weight.grad, norm.bias.grad, *norm.buffers(), norm.eval()(x)])
    for found, wanted in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("grid", [0, -8, 7])
def test_impossible_grids_are_refused(grid: int) -> None:
    for build in (Space, ImageEncoder):
        with pytest.raises(ValueError, match=rf"model.grid={grid} must be an 8th, 16th or 32nd"):
            build(128, grid)

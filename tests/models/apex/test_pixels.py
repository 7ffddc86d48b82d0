"""What masks see of the image itself: shifts of mask logits by features of pixels."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.models.apex import ApexNormalisation, Background, MixtureLikelihood, ScalorNormalisation
from apex_lab.models.apex.pixels import PixelEvidence
from apex_lab.models.apex.windows import window_of
from apex_lab.scene import Context, schedule_at
from tests.models.apex import small


def evidence(what: int = 6) -> PixelEvidence:
    torch.manual_seed(0)
    built = PixelEvidence(what, features=5, width=8).double()
    torch.nn.init.normal_(built.query.weight)
    torch.nn.init.normal_(built.query.bias)
    return built


def numbers(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_shifts_are_the_product_of_query_and_features_cut_out_by_the_window() -> None:
    model = evidence()
    image, empty, what = numbers(2, 3, 16, 16), numbers(2, 3, 16, 16).flip(0), numbers(2, 3, 6) - 0.5
    window = torch.stack([0.2 + 0.5 * numbers(2, 3), 0.3 + 0.4 * numbers(2, 3).flip(0), *(numbers(2, 2, 3) - 0.5)], -1)
    features = model(image, empty)
    got = model.shifts(features, what, window, 8)
    for n in range(2):
        for k in range(3):
            query = model.query.weight @ what[n, k] + model.query.bias
            map_ = sum(query[c] * features[n, c] for c in range(5))
            s_y, s_x, t_y, t_x = window[n, k]
            theta = torch.stack([torch.stack([s_x, 0 * s_x, t_x]), torch.stack([0 * s_y, s_y, t_y])])[None]
            grid = F.affine_grid(theta, [1, 1, 8, 8], align_corners=False)
            want = F.grid_sample(map_[None, None], grid, align_corners=False)[0, 0]  # type: ignore[index]
            torch.testing.assert_close(got[n, k], want)


def test_features_see_the_image_and_its_difference_from_the_empty_scene_alone() -> None:
    model = evidence()
    image, empty = numbers(1, 3, 16, 16), numbers(1, 3, 16, 16) * 0.5
    want = model.convs(torch.cat([image - 0.5, image - empty], dim=1))
    torch.testing.assert_close(model(image, empty), want)


def test_images_may_be_wider_than_high() -> None:
    model = evidence()
    what, window = numbers(2, 3, 6) - 0.5, torch.tensor([0.5, 0.5, 0.1, -0.2]).double().expand(2, 3, 4)
    features = numbers(2, 5, 8, 16)
    got = model.shifts(features, what, window, 4)
    for n, k in ((0, 0), (1, 2)):
        torch.testing.assert_close(
            got[n, k], model.shifts(features[n : n + 1], what[n : n + 1, k : k + 1], window[:1, :1], 4)[0, 0]
        )


def test_windows_get_no_gradient_and_everything_else_does() -> None:
    model = evidence()
    what, window = numbers(1, 2, 6).requires_grad_(), (0.2 + 0.3 * numbers(1, 2, 4)).requires_grad_()
    features = model(numbers(1, 3, 16, 16), numbers(1, 3, 16, 16) * 0.5)
    model.shifts(features, what, window, 8).square().sum().backward()
    assert window.grad is None
    assert what.grad is not None
    for weight in (what, *model.parameters()):
        assert weight.grad is not None
        assert weight.grad.abs().sum() > 0


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
def test_raw_is_the_inverse_of_logits(masks: ApexNormalisation | ScalorNormalisation) -> None:
    raw = torch.linspace(-6, 6, 50, dtype=torch.float64)
    torch.testing.assert_close(masks.raw(masks.logits(raw)), raw)
    extreme = masks.raw(masks.logits(torch.tensor([-90.0, 90.0])))
    assert extreme.isfinite().all()
    assert extreme[0] < -7
    assert extreme[1] > 7
    half = torch.tensor([-8.0, -4.0, 0.5, 4.0, 8.0], dtype=torch.bfloat16, requires_grad=True)
    again = masks.raw(masks.logits(half))
    assert again.isfinite().all()
    again.sum().backward()
    assert half.grad is not None
    assert half.grad.isfinite().all()


def test_untrained_masks_are_those_of_codes_alone() -> None:
    plain, seeing = small.tiny().eval(), small.tiny(pixel_features=4).eval()
    missing = seeing.load_state_dict(plain.state_dict(), strict=False)
    assert all(name.startswith("pixels.") for name in missing.missing_keys)
    video = small.video(2, 3)
    with torch.no_grad():
        a, b = plain(video, small.CONTEXT), seeing(video, small.CONTEXT)
    torch.testing.assert_close(a.masks, b.masks, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("refinement", [0.5, 1.0])
def test_refinement_is_how_much_of_the_shift_counts(refinement: float) -> None:
    model = small.tiny(pixel_features=4).double()
    assert model.pixels is not None
    torch.nn.init.normal_(model.pixels.query.weight)
    values = dict(small.SCHEDULE) | {"refinement": torch.tensor(refinement, dtype=torch.float64)}
    images = numbers(2, 3, small.SIZE, small.SIZE)
    what, place, raw = numbers(2, 3, 6), numbers(2, 3, 4) - 0.5, 4 * numbers(2, 3, 8, 8) - 2
    features = model._evidence(images, values)
    assert features is not None
    got = model.sharpened(model.masks.logits(raw), what, place, features, values)
    shift = model.pixels.shifts(features, what, window_of(place), 8)
    assert shift.abs().max() > 0.01
    torch.testing.assert_close(got, 5.0 * torch.tanh(raw + refinement * shift), rtol=1e-6, atol=1e-6)


def test_pixels_that_do_not_count_cost_nothing_and_have_gradients_of_zero() -> None:
    model = small.tiny(pixel_features=4).double()
    assert model.pixels is not None
    torch.nn.init.normal_(model.pixels.query.weight)
    values = dict(small.SCHEDULE) | {"refinement": torch.zeros((), dtype=torch.float64)}
    assert model._evidence(numbers(2, 3, small.SIZE, small.SIZE), values) is None
    what, place, alpha = numbers(2, 3, 6), numbers(2, 3, 4), numbers(2, 3, 8, 8)
    got = model.sharpened(alpha, what, place, None, values)
    assert torch.equal(got, alpha)
    got.sum().backward()
    for name, weight in model.pixels.named_parameters():
        assert weight.grad is not None, name
        assert not weight.grad.any(), name


def test_a_missing_refinement_counts_in_full() -> None:
    model = small.tiny(pixel_features=4).eval()
    assert model.pixels is not None
    torch.nn.init.normal_(model.pixels.query.weight)
    video = small.video(1, 2)
    full = Context({**small.SCHEDULE, **schedule_at({"refinement": 1.0})}, detail=True)
    none = Context({**small.SCHEDULE, **schedule_at({"refinement": 0.0})}, detail=True)
    with torch.no_grad():
        missing = model(video, small.CONTEXT).masks
        torch.testing.assert_close(missing, model(video, full).masks)
        assert (missing - model(video, none).masks).abs().max() > 1e-3


def whole(over: Literal["channel", "pixel"], whole_colours: bool, **values: float) -> tuple[Tensor, Tensor]:
    """nll and posterior of one model that draws shadows, with a mixture over channels or pixels."""
    torch.manual_seed(0)
    background = Background(small.SIZE, 6, 6, shadow=0.7)
    model = small.tiny(
        likelihood=MixtureLikelihood(mixture_over=over), whole_colours=whole_colours, background=background
    )
    context, video = Context({**small.SCHEDULE, **schedule_at(values)}, detail=True), small.video(1, 2)
    with torch.no_grad():
        scene = model.eval()(video, context)
        return scene.terms["nll"], model.posterior(scene, video, context)


def test_whole_colours_go_from_channels_to_pixels_in_loss_and_posterior() -> None:
    channels, pixels = whole("channel", False), whole("pixel", False)
    assert (channels[0] - pixels[0]).abs() > 1
    assert (channels[1] - pixels[1]).abs().max() > 0.01
    for values, want in (({"refinement": 0.0}, channels), ({"refinement": 1.0}, pixels), ({}, pixels)):
        for found, wanted in zip(whole("channel", True, **values), want, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def test_whole_colours_from_the_start_and_later_are_refused() -> None:
    with pytest.raises(ValueError, match=r"mixture_over=pixel .* set model\.whole_colours=false or"):
        whole("pixel", True)


def test_how_much_of_the_shadow_counts_is_scheduled() -> None:
    nll = [whole("channel", False, shadow=depth)[0] for depth in (0.0, 0.5, 1.0)]
    assert nll[0] > nll[1] > nll[2]
    assert torch.equal(nll[2], whole("channel", False)[0])

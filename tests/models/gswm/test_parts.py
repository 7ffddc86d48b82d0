"""Parts of G-SWM by numbers worked out by hand."""

from __future__ import annotations

import math
from unittest import mock

import pytest
import torch
from torch import nn

from apex_lab.models.gswm.discovery import Discovering, Discovery, discovering, needed_frames
from apex_lab.models.gswm.history import Interaction
from apex_lab.models.gswm.image_encoder import ImageEncoder
from apex_lab.models.gswm.latents import Attributes, attributes, draw, gaussian, kl_bernoulli, relaxed_bernoulli
from apex_lab.models.gswm.networks import conv_stack, shuffle_stack
from apex_lab.models.gswm.objective import where_prior
from apex_lab.models.gswm.propagation import Motion, Propagation
from apex_lab.models.gswm.rendering import Drawn, compose, negative_log_likelihood
from apex_lab.models.gswm.result import scene_of
from apex_lab.models.gswm.slots import keep, take
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Noise
from tests.models.gswm.small import context, tiny, video


def test_standard_deviations() -> None:
    q = gaussian(torch.tensor([[1.0, 2.0, 0.0, -50.0]]))
    assert q.mean.tolist() == [[1.0, 2.0]]
    torch.testing.assert_close(q.std, torch.tensor([[math.log(2) + 1e-4, 1e-4]]))


def test_relaxed_bernoulli() -> None:
    one = torch.tensor(1.0)
    u = torch.tensor([0.5, 0.5, 0.9])
    got = relaxed_bernoulli(torch.tensor([0.3, 0.8, 0.5]), one, u)
    torch.testing.assert_close(got, torch.tensor([0.3, 0.8, 0.9]))
    sharp = relaxed_bernoulli(torch.tensor([0.3]), torch.tensor(0.5), torch.tensor([0.5]))
    torch.testing.assert_close(sharp, torch.tensor([0.09 / (0.09 + 0.49)]))
    edge = relaxed_bernoulli(torch.tensor([0.0, 1.0, 1.0]), one, torch.tensor([0.0, 1.0, 0.0]))
    assert ((edge > 0) & (edge < 1)).all()


def test_presence_prior_costs_23_nats() -> None:
    got = kl_bernoulli(torch.tensor([1.0]), torch.tensor(1e-10))
    torch.testing.assert_close(got, torch.tensor([10 * math.log(10)]))
    same = kl_bernoulli(torch.tensor([0.2, 0.7]), torch.tensor(0.2))
    assert same[0].abs() < 1e-6
    assert same[1] > 0


def test_where_prior() -> None:
    p = where_prior(torch.zeros(4), torch.tensor(-1.5), 0.1)
    torch.testing.assert_close(p.mean, torch.tensor([-1.5, -1.5, 0.0, 0.0]))
    torch.testing.assert_close(p.std, torch.tensor([0.1, 0.1, 1.0, 1.0]))


def test_likelihood() -> None:
    x, mean = torch.rand(2, 3, 3, 4, 4), torch.rand(2, 3, 3, 4, 4)
    expected = -torch.distributions.Normal(mean, 0.1).log_prob(x).sum((1, 2, 3, 4))
    torch.testing.assert_close(negative_log_likelihood(x, mean, torch.tensor(0.1)), expected)


def test_random_numbers_are_those_of_frame_after_frame() -> None:
    draws = draw(VideoNoise(0, [4, 7]), torch.zeros(2, 3, 1), 2, 5, 3, 4, "sample")
    assert [tuple(x.shape) for x in draws] == [(2, 3, 2), (2, 3, 5, 4), (2, 3, 3, 4), (2, 3, 5), (2, 3, 3), (2, 3, 2)]
    source = VideoNoise(0, [4, 7]).at(1)
    torch.testing.assert_close(draws.context[:, 1], source.normal(torch.zeros(2, 34))[:, :2])
    torch.testing.assert_close(draws.cell_presence[:, 1], source.uniform(torch.zeros(2, 10))[:, :5])
    means = draw(Noise(), torch.zeros(2, 3, 1), 2, 5, 3, 4, "mean")
    assert not means.cells.any()
    assert (means.slot_presence == 0.5).all()


# boxes and attributes


def small_propagation(motion: Motion) -> Propagation:
    torch.manual_seed(0)
    return Propagation(3, 4, 6, 8, (4, 4), motion)


def test_what_motion_does() -> None:
    net = small_propagation(Motion(scale=0.3, shift=0.6, depth=2.0, what=0.2))
    before = attributes(torch.arange(13.0).reshape(1, 1, 13), 3)
    change, gates = torch.full((1, 1, 8), 0.5), torch.full((1, 1, 8), 0.25)
    depth, where, what = net.moved(before, change, gates)
    tanh = math.tanh(0.5)
    torch.testing.assert_close(depth, torch.tensor([[[1 + 2 * 0.25 * 0.5]]]))
    s, t = 0.3 * 0.25 * tanh, 0.6 * 0.25 * tanh
    torch.testing.assert_close(where, torch.tensor([[[2 + s, 3 + s, 4 + t, 5 + t]]]))
    torch.testing.assert_close(what, torch.tensor([[[6.0, 7.0, 8.0]]]) + 0.2 * 0.25 * tanh)


@pytest.mark.parametrize(
    ("bounded", "sizes"),
    [(False, [0.1 - 0.3 * 0.5, 0.9 + 0.3 * 0.5]), (True, [0.02, 1.0])],
    ids=["published", "bounded"],
)
def test_sizes_leave_their_range_unless_they_are_bounded(bounded: bool, sizes: list[float]) -> None:
    """Gates of a half, and changes beyond any tanh: by -0.15 and by +0.15. Centres are free either way."""
    net = small_propagation(Motion(scale=0.3, shift=0.6, bounded=bounded))
    z = torch.zeros(1, 1, 13)
    z[..., 2:6] = torch.tensor([0.1, 0.9, -0.9, 0.9])
    change = torch.zeros(1, 1, 8)
    change[..., 1:5] = torch.tensor([-50.0, 50.0, -50.0, 50.0])
    _, where, _ = net.moved(attributes(z, 3), change, torch.full((1, 1, 8), 0.5))
    torch.testing.assert_close(where[0, 0], torch.tensor([*sizes, -1.2, 1.2]))


def test_windows_of_mirrored_glimpses_have_positive_sizes() -> None:
    objects = attributes(torch.tensor([0.9, 0.0, -0.3, 0.2, 0.5, -0.5, *[0.0] * 7]).expand(1, 1, 1, 13), 3)
    drawn = Drawn(torch.zeros(1, 1, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 3, 4, 4))
    ids, tracked = torch.ones(1, 1, 1, dtype=torch.long), torch.ones(1, 1, 1, dtype=torch.bool)
    scene = scene_of(objects, ids, tracked, drawn, torch.zeros(1, 1, 3, 4, 4), {}, None, detail=True)
    assert scene.windows is not None
    torch.testing.assert_close(scene.windows[0, 0, 0], torch.tensor([0.2, 0.3, -0.5, 0.5]))  # y first
    assert float(scene.diagnostics["window_size"]) == pytest.approx(0.25)


def test_presence_only_decays_and_the_proposal_is_larger(monkeypatch: pytest.MonkeyPatch) -> None:
    import apex_lab.models.gswm.propagation as module

    net = small_propagation(Motion(grow_min=0.1, grow_max=0.3))
    with torch.no_grad():
        net.grow_net[-1].weight.zero_()
        net.grow_net[-1].bias.copy_(torch.tensor([0.0, 50.0]))
    windows = []
    crop = module.crop
    monkeypatch.setattr(module, "crop", lambda image, window, size: windows.append(window) or crop(image, window, size))
    z = torch.rand(2, 3, 13)
    after, _ = net(
        attributes(z, 3),
        torch.rand(2, 2, 3, 6),
        torch.rand(2, 3, 16, 16),
        torch.rand(2, 3, 12),
        torch.rand(2, 3),
        torch.tensor(1.0),
    )
    assert (after.pres <= z[..., :1]).all()
    torch.testing.assert_close(windows[0], torch.stack([z[..., 3] + 0.3, z[..., 2] + 0.2, z[..., 5], z[..., 4]], -1))


def test_propagation_map_shows_objects_at_their_cells() -> None:
    torch.manual_seed(0)
    net = Discovery(4, 4, 3, 4, 6, 0.1, 0.8)
    z = torch.zeros(1, 2, 13)
    z[:, :, 4:6] = torch.tensor([[-0.75, -0.25], [0.5, 0.5]])  # x, y: a cell's centre; a corner of four cells
    z[:, :, 0] = torch.tensor([0.5, 1.0])
    tracked = attributes(z, 3)
    shown = net.propagation_map(tracked)[0]
    assert shown.shape == (6, 4, 4)
    expected = net.map_net(z)[0, 0] * 0.5 / (2 * math.pi * 0.01)
    torch.testing.assert_close(shown[:, 1, 0], expected, rtol=1e-3, atol=1e-3)  # row of y, column of x
    assert shown[:, 3, 0].abs().max() < 1e-3 * expected.abs().max()
    corner = net.map_net(z)[0, 1] / (2 * math.pi * 0.01) * math.exp(-2 * 0.25**2 / 0.02)
    torch.testing.assert_close(shown[:, 2, 2], corner, rtol=1e-3, atol=1e-4)


def test_rejected_objects_pay() -> None:
    """A cell's object on top of a tracked one vanishes, but its KL counts the presence before that."""
    torch.manual_seed(0)
    net = Discovery(4, 4, 3, 4, 6, 0.1, 0.5)
    features, noise = torch.rand(1, 4, 4, 4), torch.zeros(1, 16, 12)
    first, _ = net(features, None, noise, torch.full((1, 16), 0.5), torch.tensor(1.0))
    tracked = Attributes(torch.ones(1, 1, 1), *(part[:, 5:6].detach() for part in first[1:]))
    net.map_net.apply(lambda m: nn.init.zeros_(m.weight) if isinstance(m, nn.Linear) else None)
    net.map_net.apply(lambda m: nn.init.zeros_(m.bias) if isinstance(m, nn.Linear) else None)
    found, posterior = net(features, tracked, noise, torch.full((1, 16), 0.5), torch.tensor(1.0))
    assert found.pres[0, 5] == 0
    assert (posterior.pres > 0).all()
    assert (found.pres[0, [0, 10, 15]] > 0).all()
    weak = tracked._replace(pres=torch.full((1, 1, 1), 0.5))
    assert (net(features, weak, noise, torch.full((1, 16), 0.5), torch.tensor(1.0))[0].pres > 0).all()


def test_interaction_reads_pairs() -> None:
    """Against the networks applied to concatenated pairs."""
    torch.manual_seed(0)
    net = Interaction(9, 4)
    phi = torch.rand(2, 1, 3, 13)
    presence = torch.tensor([[0.9, 0.1, 0.5]])
    got = net(phi, phi, presence, None, torch.eye(3, dtype=torch.bool)[None], net.fused())
    for chain in range(2):

        def read(mlp: nn.Module, x: torch.Tensor, chain: int = chain) -> torch.Tensor:
            for i, layer in enumerate((mlp.first, mlp.second, mlp.last)):
                x = x @ layer.weight[chain] + layer.bias[chain, 0]
                x = x if i == 2 else nn.functional.celu(x)
            return x

        for k in range(3):
            pairs = []
            for j in range(3):
                other = phi[chain, 0, j].clone()
                other[4:6] = phi[chain, 0, k, 4:6] - other[4:6]
                pairs.append(torch.cat([phi[chain, 0, k], other]))
            stacked = torch.stack(pairs)
            weights = read(net.logit_net, stacked)[:, 0].softmax(0) * presence[0]
            weights = weights * (torch.arange(3) != k)
            weights = weights / (weights.sum() + 1e-4)
            expected = read(net.self_net, phi[chain, 0, k]) + (weights[:, None] * read(net.pair_net, stacked)).sum(0)
            torch.testing.assert_close(got[chain, 0, k], expected, rtol=1e-4, atol=1e-5)


# selection


def test_who_is_kept() -> None:
    found, tracked = torch.tensor([[0.9, 0.0, 0.6]]), torch.tensor([[0.7, 0.1, 0.8]])
    kept = keep(found, tracked, torch.tensor([[5, 6, 7]]), torch.tensor([20]), 3, None)
    assert kept.source.tolist() == [[3, 0, 5]]  # the free slot takes the best new one
    assert kept.ids.tolist() == [[5, 20, 7]]
    kept = keep(found, tracked, torch.tensor([[5, 6, 7]]), torch.tensor([20]), 3, torch.tensor([False]))
    assert kept.ids.tolist() == [[5, 6, 7]]


def test_discovered_ones_come_first_on_ties() -> None:
    kept = keep(
        torch.tensor([[0.5, 0.2]]), torch.tensor([[0.5, 0.5]]), torch.tensor([[1, 2]]), torch.tensor([9]), 2, None
    )
    assert kept.ids.tolist() == [[1, 9]]


def test_take_along_another_dimension() -> None:
    values, source = torch.rand(2, 3, 5, 4), torch.tensor([[0, 4], [1, 1], [2, 3]])
    got = take(values, source, dim=2)
    assert got.shape == (2, 3, 2, 4)
    assert torch.equal(got[1, 0, 1], values[1, 0, 4])
    assert torch.equal(got[0, 2, 0], values[0, 2, 2])


# rendering


def test_objects_share_pixels_by_importance() -> None:
    """Two objects over one pixel; a mask enters once."""
    alpha = torch.tensor([0.8, 0.4])
    pasted = torch.cat([(alpha * torch.tensor([1.0, 0.5]))[:, None].expand(2, 3), alpha[:, None]], 1)[
        None, :, :, None, None
    ]
    near = torch.tensor([[0.25, 0.5]])
    image, masks = compose(pasted, near)
    share = 0.2 / (0.4 + 1e-5)
    torch.testing.assert_close(masks.flatten(), torch.tensor([share * 0.8, share * 0.4]))
    torch.testing.assert_close(image.flatten(), torch.full((3,), share * (0.8 + 0.2)))


def test_gradient_of_the_composition() -> None:
    torch.manual_seed(0)
    pasted = torch.rand(2, 3, 4, 3, 5, dtype=torch.float64, requires_grad=True)
    near = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(compose, (pasted, near))


# networks


def test_stacks() -> None:
    stack = conv_stack(3, (16, 32), first_kernel=7)
    assert [type(m).__name__ for m in stack] == ["Conv2d", "CELU", "GroupNorm"] * 2
    assert [m.num_groups for m in stack if isinstance(m, nn.GroupNorm)] == [1, 2]
    decoder = shuffle_stack((128, 64, 32, 16), 3)
    convs = [(m.in_channels, m.out_channels) for m in decoder if isinstance(m, nn.Conv2d)]
    assert convs == [(128, 256), (64, 128), (32, 64), (16, 12)]
    assert [m.num_groups for m in decoder if isinstance(m, nn.GroupNorm)] == [4, 2, 1]
    assert isinstance(decoder[-1], nn.Sigmoid)


@pytest.mark.parametrize(("size", "grid", "stride"), [(64, 8, 1), (64, 4, 2), (128, 8, 2), (128, 4, 4), (32, 4, 1)])
def test_last_stride_of_the_image_encoder(size: int, grid: int, stride: int) -> None:
    net = ImageEncoder(size, grid, (4, 4, 4), (1, 1, 1), 5)
    assert net.head.stride == (stride, stride)
    assert net.eval()(torch.rand(1, 2, 6, size, size)).shape == (1, 2, 5, grid, grid)


def test_sizes_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="must be a multiple of 8 x grid=4"):
        ImageEncoder(48, 4)
    with pytest.raises(ValueError, match="3 stages"):
        ImageEncoder(64, 4, (8, 8), (1, 1))
    with pytest.raises(ValueError, match=r"model.max_objects=17 must be at most 16"):
        tiny(max_objects=17)
    with pytest.raises(ValueError, match="glimpse_size=12 must be a multiple of 8"):
        tiny(glimpse_size=12)
    with pytest.raises(ValueError, match=r"built for images of model.image_size=32 pixels"):
        tiny()(torch.rand(1, 1, 3, 16, 16), context((0,)))


@pytest.mark.parametrize("norm", ["frame", "clip", "group"])
def test_norms(norm: str) -> None:
    """In training, `frame` depends on the same frame of other videos, `clip` on all frames, `group` on nothing else."""
    torch.manual_seed(0)
    net = ImageEncoder(32, 4, (4, 4, 4), (1, 1, 1), 5, norm)  # type: ignore[arg-type]
    x = torch.rand(2, 3, 6, 32, 32)
    base = net(x)
    other_frame, other_video = x.clone(), x.clone()
    other_frame[0, 1] += 0.5
    other_video[1, 0] += 0.5
    frame_matters = not torch.allclose(net(other_frame)[0, 0], base[0, 0], atol=1e-5)
    video_matters = not torch.allclose(net(other_video)[0, 0], base[0, 0], atol=1e-5)
    assert (frame_matters, video_matters) == {"frame": (False, True), "clip": (True, True), "group": (False, False)}[
        norm
    ]


# which frames discover


def test_frames_that_discover() -> None:
    u = torch.rand(500, 8, 2, generator=torch.Generator().manual_seed(0))
    which = discovering(u, 0.5, "independent", first=True)
    assert which.mask is not None
    assert which.frames is None
    assert which.mask[:, 0].all()
    assert torch.equal(which.mask[:, 1:], u[:, 1:, 0] >= 0.5)
    assert not discovering(u, 0.5, "independent", first=False).mask[:, 0].all()


def test_balanced_frames_that_discover() -> None:
    u = torch.rand(2000, 8, 2, generator=torch.Generator().manual_seed(0))
    which = discovering(u, 0.5, "balanced", first=True)
    assert which.mask is not None
    assert which.frames is not None
    assert which.frames.shape == (2000, 5)  # the first one and 3 or 4 of the 7 others
    assert set(which.mask.sum(1).tolist()) == {4, 5}
    torch.testing.assert_close(which.mask[:, 1:].float().mean(0), torch.full((7,), 0.5), rtol=0, atol=0.05)
    encoded = torch.zeros_like(which.mask).scatter(1, which.frames, True)
    assert (encoded | ~which.mask).all()
    later = discovering(u[:, :4], 0.5, "balanced", first=False)
    assert later.mask is not None
    assert set(later.mask.sum(1).tolist()) == {2}


def test_one_draw_for_the_whole_batch() -> None:
    u = torch.rand(5, 2000, 2, generator=torch.Generator().manual_seed(0))
    which = discovering(u, 0.3, "batch", first=True)
    assert which.mask is not None
    assert which.frames is None
    assert which.mask[:, 0].all()
    assert torch.equal(which.mask[:, 1:], (u[:1, 1:, 0] >= 0.3).expand(5, -1))
    assert float(which.mask[0].float().mean()) == pytest.approx(0.7, abs=0.05)
    assert tiny(norm="group", discovery_draw="batch").batch_statistics
    assert not tiny(norm="group").batch_statistics


def test_only_frames_in_which_a_video_discovers_are_needed() -> None:
    mask = torch.tensor([[True, False, True, False], [True, False, False, False]])
    needed = needed_frames(Discovering(mask, None))
    assert needed is not None
    assert needed.tolist() == [[0, 2], [0, 2]]
    none = needed_frames(Discovering(torch.zeros_like(mask), None))
    assert none is not None
    assert none.tolist() == [[0], [0]]
    assert needed_frames(Discovering(torch.ones_like(mask), None)) is None
    assert needed_frames(Discovering(None, None)) is None


def test_statistics_of_a_clip_are_of_all_its_frames() -> None:
    """With `clip`, a frame in which no video discovers still counts: on every device the same."""
    model = tiny(norm="clip", discovery_dropout=1.0).train()
    with mock.patch.object(model.image_encoder, "forward", wraps=model.image_encoder.forward) as encoder:
        model(video(), context())
    assert encoder.call_args.args[0].shape[:2] == (3, 5)


@pytest.mark.parametrize("how", ["independent", "balanced", "batch"])
def test_dropout_zero_discovers_always(how: str) -> None:
    u = torch.rand(5, 4, 2)
    assert discovering(u, 0.0, how, first=True).mask.all()  # type: ignore[arg-type, union-attr]
    never = discovering(u, 1.0, how, first=True).mask  # type: ignore[arg-type]
    assert never is not None
    assert never.sum() == 5


def test_a_video_of_one_frame() -> None:
    scene = tiny(discovery_draw="balanced")(video(2, 1), context((0, 1)))
    assert (scene.terms["kl_propagation"] == 0).all()
    assert (scene.terms["kl_dyna"] > 0).all()

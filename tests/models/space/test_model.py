"""SPACE as a `SceneModel`: what it promises to everything that uses it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apex_lab.models.space import Space
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Noise, Scene
from tests.models.space.common import close, context, small, video


@pytest.fixture(scope="module")
def model() -> Space:
    return small().eval()


def noise(videos: tuple[int, ...] = (0, 1), first_frame: int = 0) -> Noise:
    return VideoNoise(seed=3, videos=videos, first_frame=first_frame)


@pytest.fixture(scope="module")
def scene(model: Space) -> Scene:
    with torch.no_grad():
        return model(video(), context(noise(), detail=True))


def test_masks_presence_and_ids(scene: Scene) -> None:
    assert scene.masks.shape == (2, 3, 17, 32, 32)
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(2, 3, 32, 32))
    assert scene.masks.min() >= 0
    assert scene.background.tolist() == [False] * 16 + [True]
    assert scene.ids[0, 0].tolist() == [*range(1, 17), 0]
    assert (scene.ids == scene.ids[:1, :1]).all()
    assert scene.presence[..., -1].eq(1).all()
    assert scene.presence[..., :-1].gt(1.4e-4).all()
    assert scene.state is None


def test_windows_and_means_come_with_detail_alone(model: Space, scene: Scene) -> None:
    assert scene.windows is not None
    assert scene.means is not None
    assert scene.windows[..., -1, :].isnan().all()
    assert scene.windows[..., :-1, :].isfinite().all()
    assert scene.means.shape == (2, 3, 17, 3, 32, 32)
    assert scene.means.min() >= 0
    assert scene.means.max() <= 1 + 1e-6
    with torch.no_grad():
        plain = model(video(), context(noise()))
    assert plain.windows is None
    assert plain.means is None


def test_reconstruction_blends_foreground_and_background(scene: Scene) -> None:
    assert scene.reconstruction.shape == (2, 3, 3, 32, 32)
    assert scene.reconstruction.min() >= 0
    assert scene.reconstruction.max() <= 1 + 1e-5


def test_segmentation_takes_cells_with_a_presence_below_one_half_out(scene: Scene) -> None:
    labels = scene.segmentation()
    absent = scene.presence < 0.5
    for b in range(2):
        for t in range(3):
            gone = scene.ids[b, t][absent[b, t]]
            assert not torch.isin(labels[b, t], gone).any()


def test_evaluation_repeats_and_samples(model: Space) -> None:
    with torch.no_grad():
        first, again, other = (
            model(video(), context(n)) for n in (noise(), noise(), VideoNoise(seed=4, videos=(0, 1)))
        )
    assert torch.equal(first.masks, again.masks)
    assert not torch.allclose(first.appearance, other.appearance)


def test_all_randomness_comes_from_the_context(model: Space) -> None:
    found = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        with torch.no_grad():
            found.append(model(video(), context(noise())).masks)
    assert torch.equal(*found)


def same(found: Scene, expected: Scene) -> None:
    torch.testing.assert_close(found.masks, expected.masks, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.appearance, expected.appearance, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.reconstruction, expected.reconstruction, atol=1e-4, rtol=0)


def test_chunks_give_what_the_whole_video_gives(model: Space) -> None:
    frames = video(shape=(2, 7, 3, 32, 32))
    with torch.no_grad():
        whole = model(frames, context(noise()))
        a = model(frames[:, :3], context(noise()))
        b = model(frames[:, 3:], context(noise(first_frame=3)))
    joined = {name: torch.cat([getattr(a, name), getattr(b, name)], 1) for name in ("masks", "appearance")}
    torch.testing.assert_close(joined["masks"], whole.masks, atol=1e-4, rtol=0)
    torch.testing.assert_close(joined["appearance"], whole.appearance, atol=1e-4, rtol=0)
    for name in model.term_names:
        close(a.terms[name] + b.terms[name], whole.terms[name])


def test_evaluation_does_not_depend_on_the_batch(model: Space, scene: Scene) -> None:
    with torch.no_grad():
        alone = model(video()[1:], context(noise(videos=(1,))))
    torch.testing.assert_close(alone.masks, scene.masks[1:], atol=1e-4, rtol=0)
    for name in model.term_names:
        close(alone.terms[name], scene.terms[name][1:])


def test_frames_do_not_depend_on_each_other(model: Space, scene: Scene) -> None:
    changed = video()
    changed[:, 1] = 0.5
    with torch.no_grad():
        found = model(changed, context(noise()))
    torch.testing.assert_close(found.masks[:, ::2], scene.masks[:, ::2], atol=1e-4, rtol=0)
    assert not torch.allclose(found.masks[:, 1], scene.masks[:, 1])


def loss(scene: Scene) -> Tensor:
    return torch.stack([term.mean() for term in scene.terms.values()]).sum()


def test_terms_sum_over_frames_and_gradients_reach_all_weights() -> None:
    model = small()
    scene = model(video(), context())
    assert tuple(scene.terms) == model.term_names
    assert all(term.shape == (2,) for term in scene.terms.values())
    loss(scene).backward()
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().max() > 0, name
    assert [n for n, p in model.named_parameters() if not p.requires_grad] == ["foreground.boundary_kernel"]


def test_a_fixed_alpha_changes_the_likelihood_alone(model: Space) -> None:
    with torch.no_grad():
        free, fixed = (model(video(), context(noise(), fix_alpha=on, fixed_alpha=0.1)) for on in (0.0, 1.0))
    changed = [name for name in model.term_names if not torch.allclose(free.terms[name], fixed.terms[name])]
    assert changed == ["nll"]
    assert torch.equal(free.masks, fixed.masks)


def test_a_fixed_alpha_keeps_the_likelihood_from_the_masks() -> None:
    model = small()
    model(video(), context(fix_alpha=1.0, fixed_alpha=0.0)).terms["nll"].sum().backward()
    mask_bias = model.foreground.glimpse_decoder.mask.bias
    assert mask_bias is not None
    assert mask_bias.grad is not None
    assert mask_bias.grad.abs().max() > 0  # by way of mu_fg, which has the masks in it


def test_nothing_is_wrong_in_reduced_precision(model: Space) -> None:
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        scene = model(video(), context(noise()))
    assert all(term.isfinite().all() for term in scene.terms.values())
    torch.testing.assert_close(scene.masks.float().sum(2), torch.ones(2, 3, 32, 32))


def test_training_in_reduced_precision() -> None:
    model = small()
    with torch.autocast("cpu", torch.bfloat16):
        loss(model(video(), context())).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters() if p.requires_grad)


@pytest.mark.parametrize(("size", "grid"), [(64, 8), (128, 16)])
def test_other_sizes(size: int, grid: int) -> None:
    with torch.no_grad():
        scene = small(image_size=size, grid=grid, glimpse_size=16).eval()(
            video(shape=(1, 1, 3, size, size)), context(detail=True)
        )
    assert scene.masks.shape == (1, 1, grid**2 + 1, size, size)


def test_wrong_sizes_are_named(model: Space) -> None:
    with pytest.raises(ValueError, match=r"built for 32 px images.*set model.image_size=64"):
        model(video(shape=(1, 1, 3, 64, 64)), context())
    with pytest.raises(ValueError, match=r"model.grid=2 .* set model.grid to one of \[16, 8, 4\]"):
        Space(grid=2)
    with pytest.raises(ValueError, match=r"model.image_size=96 must be a power of two"):
        Space(image_size=96)


def test_a_cell_with_a_presence_of_one_half_is_absent() -> None:
    """space.md section 10: an object exists where the probability is above 0.5."""
    model = small(grid=4).eval()
    with torch.no_grad():
        for parameter in model.foreground.presence.parameters():
            parameter.zero_()  # q(pres) = sigmoid(0)
    scene = model(video(), context())
    assert float(scene.presence[..., :-1].max()) == pytest.approx(0.5)
    assert (scene.segmentation() == 0).all()
    assert float(scene.diagnostics["live_objects"]) == 0
    with torch.no_grad():
        model.foreground.presence.bias.fill_(1e-5)
    scene = model(video(), context())
    assert (scene.presence >= 0.5).all()
    assert float(scene.diagnostics["live_objects"]) == 16

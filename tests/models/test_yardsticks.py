"""The classical yardsticks and the two tests of the evaluation, on videos whose right answer is known."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import permutations

import numpy as np
import pytest
import torch
from sklearn.metrics import adjusted_rand_score
from torch import Tensor

from apex_lab.metrics import SceneMetrics, scene_identities
from apex_lab.metrics.evaluator import Evaluator
from apex_lab.models.yardsticks import BackgroundSubtraction, ColorClusters, OneSegment, Oracle
from apex_lab.models.yardsticks.linking import Linked, link
from apex_lab.scene import ABSENT, Context, Scene, SceneModel, Statistics

T, SIZE = 6, 48
TABLE = torch.tensor([0.55, 0.45, 0.35])
COLORS = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.7, 0.2], [0.15, 0.2, 0.9]])


def squares(seed: int, objects: int = 3) -> tuple[Tensor, Tensor]:
    """(T, 3, H, W) video and (T, H, W) labels: plain squares in lanes of their own that glide sideways."""
    generator = torch.Generator().manual_seed(seed)
    video = TABLE[:, None, None].expand(T, 3, SIZE, SIZE).clone()
    labels = torch.zeros(T, SIZE, SIZE, dtype=torch.uint8)
    for k in range(objects):
        side, top = 8 + int(torch.randint(4, (1,), generator=generator)), 2 + 15 * k
        start, step = 5 + int(torch.randint(8, (1,), generator=generator)), k - 1
        for t in range(T):
            here = (slice(top, top + side), slice(start + 2 * step * t + 12, start + 2 * step * t + 12 + side))
            video[t, :, here[0], here[1]] = COLORS[k][:, None, None]
            labels[t, here[0], here[1]] = k + 1
    return video, labels


def batch(videos: int = 3, objects: int = 3) -> tuple[Tensor, Tensor]:
    video, labels = zip(*(squares(seed, objects) for seed in range(videos)), strict=True)
    return torch.stack(video), torch.stack(labels)


def subtraction(radius: int = 0) -> BackgroundSubtraction:
    model = BackgroundSubtraction(image_size=SIZE, radius=radius)
    model.initialise(table_picture())
    return model


def learners() -> Iterator[SceneModel]:
    yield ColorClusters(colors=4)
    yield ColorClusters(colors=8)  # more clusters than colours
    yield subtraction()


def all_yardsticks() -> Iterator[SceneModel]:
    yield from learners()
    yield subtraction(radius=1)
    yield OneSegment()
    yield Oracle()


def run(model: SceneModel, video: Tensor, labels: Tensor, context: Context | None = None) -> Scene:
    context = context or Context(detail=True)
    return model.from_labels(video, labels, context) if model.needs_labels else model(video, context)


def table_picture(side: int = SIZE) -> Statistics:
    """Training statistics whose median is the empty table."""
    return Statistics(lambda: TABLE[:, None, None].expand(3, side, side))


@pytest.mark.parametrize("model", [*learners(), Oracle()], ids=lambda m: type(m).__name__)
def test_moving_squares_are_found_exactly_and_keep_their_identity(model: SceneModel) -> None:
    video, labels = batch()
    found = run(model, video, labels).segmentation()
    for b in range(len(video)):
        # over the whole video at once: an identity that changes, or is used for two objects, costs
        assert adjusted_rand_score(labels[b].flatten().numpy(), found[b].flatten().numpy()) == 1.0
    assert (found[labels == 0] == 0).all()


@pytest.mark.parametrize("model", list(all_yardsticks()), ids=lambda m: type(m).__name__)
def test_scenes_keep_the_contract(model: SceneModel) -> None:
    video, labels = batch()
    scene = run(model, video, labels)
    b, t, k = scene.ids.shape
    assert scene.masks.shape == (b, t, k, SIZE, SIZE)
    assert scene.masks.dtype == video.dtype
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(b, t, SIZE, SIZE))
    assert scene.background.tolist() == [True] + [False] * (k - 1)
    assert ((scene.presence == 0) == (scene.ids == ABSENT)).all()
    assert (scene.masks[scene.ids == ABSENT] == 0).all()
    for b_, t_ in np.ndindex(b, t):
        alive = scene.ids[b_, t_][scene.ids[b_, t_] != ABSENT]
        assert len(alive.unique()) == len(alive), "an identity stands twice in one frame"
    assert scene.means is not None
    composed = torch.einsum("btkhw,btkchw->btchw", scene.masks, scene.means)
    torch.testing.assert_close(scene.reconstruction, composed)
    assert scene.terms == {}
    assert model.needs_training is False
    assert not list(model.parameters())
    assert model.term_names == ()
    assert model.schedule_ranges == {}


@pytest.mark.parametrize("model", list(all_yardsticks()), ids=lambda m: type(m).__name__)
def test_a_video_does_not_depend_on_its_batch(model: SceneModel) -> None:
    video, labels = batch()
    video = (video + 0.05 * torch.rand(video.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    whole = run(model, video, labels)
    again = run(model, video, labels)
    assert torch.equal(whole.masks, again.masks)
    for b in range(len(video)):
        alone = run(model, video[b : b + 1], labels[b : b + 1])
        assert torch.equal(alone.masks[0], whole.masks[b])
        assert torch.equal(alone.ids[0], whole.ids[b])
        torch.testing.assert_close(alone.reconstruction[0], whole.reconstruction[b])


@pytest.mark.parametrize("model", list(all_yardsticks()), ids=lambda m: type(m).__name__)
def test_half_precision_changes_nothing(model: SceneModel) -> None:
    video, labels = batch(1)
    whole = run(model, video, labels)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = run(model, video, labels)
    for name in ("masks", "ids", "appearance", "reconstruction"):
        assert torch.equal(getattr(half, name), getattr(whole, name)), name


@pytest.mark.parametrize("objects", [1, 2, 3])
def test_one_segment_scores_what_arithmetic_says(objects: int) -> None:
    video, labels = batch(objects=objects)
    scores = SceneMetrics()
    scores.update(scene_identities(OneSegment()(video, Context()), labels.shape[-2:]), labels.long())
    result = scores.compute()
    share = labels.flatten(2).float().gt(0).float().mean(2)  # of pixels that objects cover
    assert result["msc"] == pytest.approx(1 / (objects + 1), abs=1e-12)
    assert result["msc_fg"] == pytest.approx(float(share.double().mean()) / objects, abs=1e-6)
    assert result["ari"] == 0.0
    assert result["ari_fg"] == (1.0 if objects == 1 else 0.0)


def test_oracle_scores_all_ones() -> None:
    video, labels = batch()
    labels[0, 2][labels[0, 2] == 3] = 0  # hidden for a frame
    scene = Oracle().from_labels(video, labels)
    scores = SceneMetrics()
    scores.update(scene_identities(scene, labels.shape[-2:]), labels.long())
    assert all(value == 1.0 for value in scores.compute().values())
    evaluator = Evaluator()
    for b in range(len(video)):
        evaluator.add(str(b), scene_identities(scene, labels.shape[-2:])[b].numpy(), labels[b].numpy())
    total = evaluator.result()["total"]
    assert all(total[name] == 100.0 for name in ("mota", "motp", "match", "md", "mt"))
    assert all(total[name] == 0.0 for name in ("id_switches", "fps", "misses"))
    assert all(total[name] == 1.0 for name in ("idf1", "hota", "jf", "mbo", "video_ari", "video_ari_fg"))
    assert torch.equal(scene.segmentation(), labels.long())
    assert scene.ids[0, :, 3].tolist() == [3, 3, ABSENT, 3, 3, 3]
    assert torch.equal(scene.reconstruction, video)


def test_oracle_refuses_what_it_cannot_know() -> None:
    video, labels = batch(1)
    with pytest.raises(TypeError, match="from_labels"):
        Oracle()(video, Context())
    with pytest.raises(ValueError, match=r"labels from 0 to 3.*model\.max_label=3"):
        Oracle(max_label=2).from_labels(video, labels)
    with pytest.raises(ValueError, match="label -1"):
        Oracle().from_labels(video, labels.long() - 1)
    with pytest.raises(TypeError, match="does not read the ground truth"):
        OneSegment().from_labels(video, labels)


def test_background_subtraction_carries_its_picture_in_the_checkpoint() -> None:
    video, _ = batch()
    trained, fresh = subtraction(), BackgroundSubtraction(image_size=SIZE, radius=0)
    with pytest.raises(ValueError, match="no median image"):
        fresh(video, Context())
    file = io.BytesIO()
    torch.save(trained.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(fresh(video, Context()).masks, trained(video, Context()).masks)


def test_background_subtraction_repaints_a_plain_scene() -> None:
    video, _ = batch()
    torch.testing.assert_close(subtraction()(video, Context()).reconstruction, video)


def test_background_subtraction_refuses_other_sizes() -> None:
    with pytest.raises(ValueError, match=r"median has the shape \(3, 8, 8\).*model.image_size=8"):
        BackgroundSubtraction(image_size=SIZE).initialise(Statistics(lambda: torch.zeros(3, 8, 8)))
    with pytest.raises(ValueError, match=r"video has frames of the shape \(3, 8, 8\).*model.image_size=8"):
        subtraction()(torch.zeros(1, 1, 3, 8, 8), Context())


def test_background_subtraction_finds_what_differs_by_more_than_the_threshold() -> None:
    video, labels = batch(1, objects=2)
    close = TABLE[:, None, None].expand_as(video).clone()
    close[:, :, :, labels[0, 0] == 1] = TABLE[:, None] + 0.04  # 0.069 in RGB
    close[:, :, :, labels[0, 0] == 2] = TABLE[:, None] + 0.05  # 0.087
    found = subtraction()(close, Context()).segmentation()
    assert torch.equal(found > 0, (labels[:, :1] == 2).expand_as(found))


@pytest.mark.parametrize(
    ("color", "shadow", "found"),
    [
        (0.5 * TABLE, 0.4, False),  # a shadow
        (0.5 * TABLE, 1.0, True),  # ... which is taken for an object if it is not known
        (0.3 * TABLE, 0.4, True),  # 0.1 of 0.79 too dark for one
        (1.2 * TABLE, 0.4, True),  # light is no shadow
        (0.5 * TABLE.flip(0), 0.4, True),  # dark, but of another hue
    ],
)
def test_background_subtraction_knows_shadows(color: Tensor, shadow: float, found: bool) -> None:
    model = BackgroundSubtraction(SIZE, threshold=0.07, shadow=shadow, radius=0)
    model.initialise(table_picture())
    video = TABLE[:, None, None].expand(1, 1, 3, SIZE, SIZE).clone()
    video[..., 10:20, 10:20] = color[:, None, None]
    seen = model(video, Context()).segmentation()[0, 0] > 0
    assert seen.sum() == (100 if found else 0)


def test_color_clusters_weigh_hue_above_lightness() -> None:
    video = torch.tensor([0.5, 0.5, 0.5])[:, None, None].expand(1, 1, 3, SIZE, SIZE).clone()
    video[..., 24:, :] = 0.35  # the lower half in shadow
    video[..., 10:20, 10:20] = torch.tensor([0.6, 0.45, 0.45])[:, None, None]
    plain, weighted = (
        ColorClusters(colors=2, lightness=weight)(video, Context()).segmentation()[0, 0] for weight in (1.0, 0.1)
    )
    assert plain[40, 5] != plain[5, 5]
    assert plain[15, 15] == plain[5, 5]
    assert weighted[40, 5] == weighted[5, 5] == 0
    assert (weighted > 0).sum() == 100


def test_small_regions_are_no_objects() -> None:
    video = TABLE[:, None, None].expand(1, 1, 3, SIZE, SIZE).clone()
    video[..., 10:12, 10:12] = 0.0  # 4 of 2304 pixels, 0.17 %
    video[..., 30:40, 30:40] = 0.0
    for model in (ColorClusters(min_area=0.01), BackgroundSubtraction(SIZE, radius=0, min_area=0.01)):
        model.initialise(table_picture())
        found = model(video, Context()).segmentation()[0, 0]
        assert found[11, 11] == 0
        assert found[35, 35] == 1
        assert (found > 0).sum() == 100


def test_only_the_largest_objects_are_kept() -> None:
    video, labels = batch(1)
    areas = labels[0, 0].flatten().bincount()[1:]
    for model in (ColorClusters(colors=4, max_objects=1), BackgroundSubtraction(SIZE, radius=0, max_objects=1)):
        model.initialise(table_picture())
        scene = model(video, Context())
        assert scene.ids.shape[2] == 2
        assert scene.masks[0, 0, 1].sum() == areas.max()


def test_background_is_the_largest_region_at_the_border() -> None:
    video = torch.zeros(1, 1, 3, SIZE, SIZE)
    video[..., :2, :] = 1.0  # a strip at the border, smaller than what lies inside
    video[..., 4:44, 4:44] = torch.tensor([0.1, 0.3, 0.9])[:, None, None]
    found = ColorClusters(colors=3)(video, Context()).segmentation()[0, 0]
    assert found[47, 0] == 0
    assert found[24, 24] > 0
    assert found[0, 0] > 0
    assert found[24, 24] != found[0, 0]


@pytest.mark.parametrize("color", [0.0, 0.5, 1.0])
def test_a_video_of_one_colour_is_background(color: float) -> None:
    video = torch.full((1, 1, 3, SIZE, SIZE), color)
    assert (ColorClusters()(video, Context()).segmentation() == 0).all()


def masks_of(*frames: list[tuple[int, int]]) -> np.ndarray:
    """(T, N, 1, 20) bool from the (first, last + 1) pixels of each region."""
    masks = np.zeros((len(frames), max(map(len, frames)), 1, 20), dtype=bool)
    for t, regions in enumerate(frames):
        for n, (first, last) in enumerate(regions):
            masks[t, n, 0, first:last] = True
    return masks


def identities(masks: np.ndarray, colors: np.ndarray, min_similarity: float = 0.3) -> np.ndarray:
    """What `link` gives for a whole video; cut anywhere, it must give the same from the last frame before the cut."""
    whole, last = link(masks, colors, min_similarity)
    for cut in range(1, len(masks)):
        first, state = link(masks[:cut], colors[:cut], min_similarity)
        second, state = link(masks[cut:], colors[cut:], min_similarity, state)
        assert np.array_equal(np.concatenate([first, second]), whole)
        assert same_frame(state, last)
    return whole


def same_frame(a: Linked, b: Linked) -> bool:
    fields = (np.array_equal(getattr(a, name), getattr(b, name)) for name in ("masks", "colors", "ids"))
    return all(fields) and a.free == b.free


def test_link_follows_regions_whatever_their_order() -> None:
    masks = masks_of([(0, 5), (10, 15)], [(11, 16), (1, 6)], [(2, 7), (12, 17)])
    assert identities(masks, np.zeros((3, 2, 3))).tolist() == [[1, 2], [2, 1], [1, 2]]


def test_link_never_gives_a_number_twice() -> None:
    masks = masks_of([(0, 5), (10, 15)], [(0, 5), (0, 0)], [(0, 5), (10, 15)], [(0, 0), (0, 0)], [(0, 5), (0, 0)])
    assert identities(masks, np.zeros((5, 2, 3))).tolist() == [[1, 2], [1, -1], [1, 3], [-1, -1], [4, -1]]


def test_link_lets_colour_decide_between_equal_overlaps() -> None:
    masks = masks_of([(0, 6)], [(0, 3), (3, 6)])
    red, blue = [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]
    colors = np.array([[red, red], [blue, red]])
    assert identities(masks, colors).tolist() == [[1, -1], [2, 1]]
    assert identities(masks, np.array([[red, red], [red, blue]])).tolist() == [[1, -1], [1, 2]]


def test_link_needs_overlap_and_likeness() -> None:
    apart = masks_of([(0, 5)], [(5, 10)])
    assert identities(apart, np.zeros((2, 1, 3))).tolist() == [[1], [2]]
    graze = masks_of([(0, 10)], [(9, 19)])  # IoU 1 / 19
    unlike = np.array([[[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]])
    assert identities(graze, unlike).tolist() == [[1], [2]]
    assert identities(graze, np.zeros((2, 1, 3))).tolist() == [[1], [1]]


def test_link_of_nothing() -> None:
    assert identities(np.zeros((3, 0, 4, 4), dtype=bool), np.zeros((3, 0, 3))).shape == (3, 0)


def test_link_is_the_best_assignment() -> None:
    """Against trying all pairings of two frames."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        masks = rng.random((2, 4, 1, 60)) < 0.5
        colors = np.full((2, 4, 3), 0.5)
        iou = [[(a & b).sum() / (a | b).sum() for b in masks[1]] for a in masks[0]]
        best = max(sum(iou[i][j] for i, j in enumerate(order)) for order in permutations(range(4)))
        ids = identities(masks, colors, min_similarity=0.0)
        pairs = [(i, j) for i, a in enumerate(ids[0]) for j, b in enumerate(ids[1]) if a == b]
        assert sum(iou[i][j] for i, j in pairs) == pytest.approx(best)

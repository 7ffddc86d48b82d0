from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from apex_lab.metrics import ari, ari_fg, covering
from apex_lab.metrics.contingency import PAD, check_labels, contingency
from apex_lab.metrics.segmentation import SCORES, video_scores

ARI_TOLERANCE, COVERING_TOLERANCE = 1e-9, 1e-5


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array)[None]


def tolerance(name: str) -> float:
    return ARI_TOLERANCE if name.startswith("ari") else COVERING_TOLERANCE


def random_labels(seed: int, shape: tuple[int, ...], high: int) -> torch.Tensor:
    return torch.randint(0, high, shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", SCORES)
def test_public_values(public, video: str, name: str) -> None:
    expected = public.values(video)["seg"]
    truth, found = tensor(public.truth(video)), tensor(public.identities(video))
    frames = video_scores(contingency(found, truth), name)
    np.testing.assert_allclose(frames[0], expected["per_frame"][name], rtol=0, atol=tolerance(name))
    mean = video_scores(contingency(found, truth), name, "frame_then_video")
    assert float(mean) == pytest.approx(expected["frame_mean"][name], rel=0, abs=tolerance(name))
    sequence = video_scores(contingency(found, truth), name, "sequence")
    assert float(sequence) == pytest.approx(expected["sequence"][name], rel=0, abs=tolerance(name))


def test_the_winning_slot_is_the_public_one(public, video: str) -> None:
    np.testing.assert_array_equal(public.slots(video), public.arrays[f"{video}__seg"])


def test_functions_are_the_named_scores(public) -> None:
    truth, found = tensor(public.truth("soft_ties")), tensor(public.identities("soft_ties"))
    table = contingency(found, truth)
    for mode in ("frame", "sequence", "frame_then_video"):
        named = {name: video_scores(table, name, mode) for name in SCORES}
        assert torch.equal(ari(found, truth, mode=mode), named["ari"])
        assert torch.equal(ari_fg(found, truth, mode=mode), named["ari_fg"])
        for background in (True, False):
            for scaled in (True, False):
                name = ("sc" if scaled else "msc") + ("" if background else "_fg")
                value = covering(found, truth, background=background, scaled=scaled, mode=mode)
                assert torch.equal(value, named[name])


@pytest.mark.parametrize("clusters", [1, 2, 5, 64])
def test_ari_agrees_with_sklearn(clusters: int) -> None:
    found, truth = random_labels(clusters, (3, 4, 8, 8), clusters), random_labels(99, (3, 4, 8, 8), 4)
    frames, sequence = ari(found, truth), ari(found, truth, mode="sequence")
    objects, all_objects = ari_fg(found, truth), ari_fg(found, truth, mode="sequence")
    for b in range(3):
        for t in range(4):
            g, p = truth[b, t].flatten().numpy(), found[b, t].flatten().numpy()
            assert float(frames[b, t]) == pytest.approx(adjusted_rand_score(g, p), abs=1e-12)
            assert float(objects[b, t]) == pytest.approx(adjusted_rand_score(g[g > 0], p[g > 0]), abs=1e-12)
        g, p = truth[b].flatten().numpy(), found[b].flatten().numpy()
        assert float(sequence[b]) == pytest.approx(adjusted_rand_score(g, p), abs=1e-12)
        assert float(all_objects[b]) == pytest.approx(adjusted_rand_score(g[g > 0], p[g > 0]), abs=1e-12)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), n=st.integers(1, 12))
def test_ari_agrees_with_sklearn_on_any_partition(data: st.DataObject, n: int) -> None:
    labels = st.lists(st.integers(0, 4), min_size=n, max_size=n)
    g, p = np.array(data.draw(labels)), np.array(data.draw(labels))
    value = float(ari(torch.from_numpy(p)[None, None, None], torch.from_numpy(g)[None, None, None]))
    assert value == pytest.approx(adjusted_rand_score(g, p), abs=1e-12)
    assert value <= 1
    other_way = float(ari(torch.from_numpy(g)[None, None, None], torch.from_numpy(p)[None, None, None]))
    assert value == pytest.approx(other_way, abs=1e-15)


@pytest.mark.parametrize(
    ("truth", "found", "value"),
    [
        ([2, 2, 2, 2], [7, 7, 7, 7], 1.0),
        ([2, 2, 2, 2], [7, 7, 7, 8], 0.0),
        ([2, 2, 2, 2], [1, 2, 3, 4], 0.0),
        ([1, 1, 2, 2], [7, 7, 7, 7], 0.0),
        ([1, 2, 3, 4], [9, 8, 7, 6], 1.0),
        ([1, 2, 3, 4], [9, 9, 7, 6], 0.0),
        ([3], [5], 1.0),
    ],
)
def test_degenerate_partitions(truth: list[int], found: list[int], value: float) -> None:
    g, p = torch.tensor(truth)[None, None, None], torch.tensor(found)[None, None, None]
    assert float(ari(p, g)) == value == adjusted_rand_score(truth, found)
    assert float(ari_fg(p, g)) == value


def test_frame_without_objects() -> None:
    truth, found = torch.zeros(1, 2, 4, 4, dtype=torch.long), random_labels(0, (1, 2, 4, 4), 3)
    truth[0, 1, 0] = 1
    assert ari_fg(found, truth)[0, 0] == 1
    assert covering(found, truth, background=False)[0, 0] == 0
    assert ari_fg(found, truth, skip_empty=True)[0, 0].isnan()
    assert covering(found, truth, background=False, skip_empty=True)[0, 0].isnan()
    only = covering(found, truth, background=False)[0, 1]
    assert covering(found, truth, background=False, skip_empty=True, mode="frame_then_video") == only
    assert not covering(found, truth, skip_empty=True).isnan().any()
    empty = torch.zeros_like(truth)
    assert ari_fg(found, empty, mode="sequence", skip_empty=True).isnan().all()
    assert ari_fg(found, empty, mode="sequence") == 1


def brute_force_covering(found: np.ndarray, truth: np.ndarray, background: bool, scaled: bool) -> float:
    values, weights = [], []
    for label in np.unique(truth):
        if label == 0 and not background:
            continue
        mask = truth == label
        values.append(max((mask & (found == k)).sum() / (mask | (found == k)).sum() for k in np.unique(found)))
        weights.append(mask.sum() if scaled else 1)
    return float(np.average(values, weights=weights)) if values else 0.0


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("scaled", [True, False])
def test_covering_agrees_with_brute_force(background: bool, scaled: bool) -> None:
    found, truth = random_labels(1, (2, 3, 9, 7), 5), random_labels(2, (2, 3, 9, 7), 4) * 3
    frames = covering(found, truth, background=background, scaled=scaled)
    videos = covering(found, truth, background=background, scaled=scaled, mode="sequence")
    for b in range(2):
        for t in range(3):
            expected = brute_force_covering(found[b, t].numpy(), truth[b, t].numpy(), background, scaled)
            assert float(frames[b, t]) == pytest.approx(expected, abs=1e-12)
        expected = brute_force_covering(found[b].numpy(), truth[b].numpy(), background, scaled)
        assert float(videos[b]) == pytest.approx(expected, abs=1e-12)


def test_bleeding_into_the_background_is_punished_by_covering_alone() -> None:
    truth = torch.zeros(1, 1, 8, 8, dtype=torch.long)
    truth[..., :2, :2], truth[..., 6:, 6:] = 1, 2
    found = truth.clone()
    found[..., 2:5, :] = 1
    assert ari_fg(found, truth) == 1
    assert covering(found, truth, background=False) < 1


@pytest.mark.parametrize("objects", [1, 2, 3, 5])
def test_one_segment_covers_one_part_in_n_plus_one(objects: int) -> None:
    truth = random_labels(objects, (1, 4, 32, 32), objects + 1)
    value = covering(torch.full_like(truth, 7), truth)
    torch.testing.assert_close(value, torch.full_like(value, 1 / (objects + 1)), rtol=0, atol=1e-15)


def test_names_of_labels_do_not_matter() -> None:
    found, truth = random_labels(3, (2, 3, 8, 8), 6), random_labels(4, (2, 3, 8, 8), 4)
    huge = torch.tensor([5, 2**40, 17, 0, 3, 2**52])[found]
    for name in SCORES:
        for mode in ("frame", "sequence"):
            here = video_scores(contingency(found, truth), name, mode)
            renamed = video_scores(contingency(huge, truth * 50), name, mode)
            torch.testing.assert_close(here, renamed, rtol=0, atol=1e-15)


def test_exact_masks_with_swapped_identities(public) -> None:
    truth, found = tensor(public.truth("id_switch")), tensor(public.identities("id_switch"))
    assert ari_fg(found, truth, mode="frame_then_video") == 1
    assert ari_fg(found, truth, mode="sequence") < 0.5


def test_a_whole_video_does_not_overflow() -> None:
    truth, found = random_labels(5, (1, 20, 128, 128), 2), random_labels(6, (1, 20, 128, 128), 2)
    found = torch.where(random_labels(7, found.shape, 2) == 0, truth, found)
    expected = adjusted_rand_score(truth.flatten().numpy(), found.flatten().numpy())
    assert float(ari(found, truth, mode="sequence")) == pytest.approx(expected, abs=1e-12)


def test_table_counts_pixels_and_pads() -> None:
    truth = torch.tensor([[[[0, 0, 3]]], [[[1, 2, 3]]]])
    found = torch.tensor([[[[4, 4, 4]]], [[[9, 8, 4]]]])
    table = contingency(found, truth)
    assert table.labels.tolist() == [[0, 3, PAD, PAD], [0, 1, 2, 3]]
    assert table.ids.tolist() == [[4, PAD, PAD], [4, 8, 9]]
    assert table.counts[0, 0].tolist() == [[2, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert table.counts[1, 0].tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]


def test_unsigned_bytes_are_labels() -> None:
    found, truth = random_labels(8, (2, 2, 6, 6), 5), random_labels(9, (2, 2, 6, 6), 3)
    assert torch.equal(ari(found.byte(), truth.byte()), ari(found, truth))


def test_refusals() -> None:
    good = torch.zeros(1, 2, 4, 4, dtype=torch.long)
    negative = good.clone()
    negative[0, 0, 0, 0] = -1
    with pytest.raises(ValueError, match="truth has the negative label -1"):
        ari(good, negative)
    with pytest.raises(ValueError, match="pixel with the identity -1"):
        covering(negative, good)
    with pytest.raises(ValueError, match="same shape"):
        check_labels(good, good[:, :1])
    with pytest.raises(ValueError, match="must be"):
        check_labels(good[0], good[0])
    with pytest.raises(TypeError, match="integer labels"):
        check_labels(good.float(), good)
    with pytest.raises(ValueError, match="no pixel"):
        ari(good[:0], good[:0])
    with pytest.raises((ValueError, TypeError), match="mode"):
        ari(good, good, mode="video")
    with pytest.raises(ValueError, match="no segmentation score"):
        video_scores(contingency(good, good), "iou")

"""Pieces that become one proposal: which pairs are judged, by a bound computed slowly, and what a union changes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex import Apex, ApexNormalisation, Background, MixtureLikelihood, merging
from apex_lab.models.apex.merging import MARGIN, TOUCHING, around, best_of, merged, touching
from apex_lab.models.apex.objects import Proposals
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import Context, schedule_at
from tests.models.apex import naive
from tests.models.apex.hull import in_tangents
from tests.models.apex.small import SCHEDULE, SIZE, lively, video

SCALES = (1.25, 0.75)
VALUES = {**SCHEDULE, **schedule_at(dict(zip(("sigma_fg_scale", "sigma_bg_scale"), SCALES, strict=True)))}
P0 = float(SCHEDULE["discovery_presence"])


@pytest.fixture
def static(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From its call on, merging works as where nobody may look at numbers."""
    return lambda: monkeypatch.setattr(merging, "may_look", lambda _: False)


def rim(a: Tensor, b: Tensor) -> float:
    """Along how many pixels two masks (H, W) meet: the least of what each is next to of the other."""

    def beside(one: Tensor, other: Tensor) -> float:
        height, width = one.shape
        total = 0.0
        for y, x in itertools.product(range(height), range(width)):
            around_it = one[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
            total += float(around_it.max() * other[y, x])
        return total

    return min(beside(a, b), beside(b, a))


def boxes(*places: tuple[int, int, int, int]) -> Tensor:
    """Masks of one frame (1, n, 16, 16) that are 1 from a row to a row and from a column to a column."""
    masks = torch.zeros(1, len(places), 16, 16)
    for mask, (top, bottom, left, right) in zip(masks[0], places, strict=True):
        mask[top:bottom, left:right] = 1
    return masks


BOXES = boxes((2, 8, 2, 6), (2, 8, 6, 12), (8, 13, 7, 12), (12, 16, 0, 4))
"""The first two share a rim of 6 pixels, the second and the third one of 5; the last is alone."""


def test_the_pairs_with_the_longest_rims_the_larger_one_first() -> None:
    there = torch.ones(1, 4, dtype=torch.bool)
    for most in (2, 4, 100):
        pairs = touching(BOXES, there, most)
        assert list(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)) == [(1, 0), (1, 2)]
        assert pairs.valid.all()
        assert (pairs.frame == 0).all()
    only = touching(BOXES, there, 1)
    assert (only.first.tolist(), only.second.tolist()) == ([1], [0])
    assert torch.equal(only.place[0], around((BOXES[0, 0] + BOXES[0, 1])[None])[0])


def test_who_is_not_there_touches_nobody() -> None:
    pairs = touching(BOXES, torch.tensor([[False, True, True, True]]), 4)
    assert (pairs.first.tolist(), pairs.second.tolist()) == ([1], [2])
    assert len(touching(BOXES, torch.zeros(1, 4, dtype=torch.bool), 4).frame) == 0


@pytest.mark.parametrize(("length", "judged"), [(4, 0), (5, 1)])
def test_a_rim_has_to_be_longer_than_the_threshold(length: int, judged: int) -> None:
    masks = boxes((2, 2 + length, 2, 6), (2, 2 + length, 6, 9))
    assert TOUCHING == 4
    assert len(touching(masks, torch.ones(1, 2, dtype=torch.bool), 4).frame) == judged


def test_rims_of_soft_masks_against_a_loop(static: Callable[[], None]) -> None:
    g = torch.Generator().manual_seed(0)
    masks = torch.rand(3, 5, 8, 8, generator=g, dtype=torch.float64) ** 3
    there = torch.rand(3, 5, generator=g) < 0.8
    assert not there.all()
    want = []
    for f in range(3):
        lengths = {
            (a, b): rim(masks[f, a], masks[f, b])
            for a, b in itertools.combinations(range(5), 2)
            if there[f, a] and there[f, b]
        }
        longest = sorted(lengths, key=lambda pair: -lengths[pair])[:3]
        want += [(f, a, b) for a, b in longest if lengths[a, b] > TOUCHING]
    assert len(want) > 4
    pairs = touching(masks, there, 3)
    rows = list(zip(pairs.frame.tolist(), pairs.first.tolist(), pairs.second.tolist(), strict=True))
    assert [(f, *sorted(pair)) for f, *pair in rows] == want
    assert all(masks[f, a].sum() >= masks[f, b].sum() for f, a, b in rows)
    static()
    everywhere = touching(masks, there, 3)
    assert len(everywhere.frame) == 9
    for some, every in zip(pairs, everywhere, strict=True):
        assert torch.equal(some, every[everywhere.valid])


def test_a_window_is_a_quarter_larger_than_the_pixels_that_it_is_around() -> None:
    masks = torch.zeros(4, 16, 16, dtype=torch.float64)
    masks[0, 3:8, 2:12] = 0.6
    masks[0, 10, 14] = 0.5  # not more than a half
    masks[1, 15, 0] = 1
    masks[2] = 1
    place = around(masks)
    assert MARGIN == 1.25
    want = torch.tensor(
        [
            [1.25 * 5 / 16, 1.25 * 10 / 16, (3 + 8) / 16 - 1, (2 + 12) / 16 - 1],
            [2 / 16, 2 / 16, 31 / 16 - 1, 1 / 16 - 1],  # two pixels at least
            [0.95, 0.95, 0.0, 0.0],
        ],
        dtype=torch.float64,
    )
    torch.testing.assert_close(window_of(place[:3]), want, rtol=1e-12, atol=1e-12)
    assert place.isfinite().all()


def test_at_most_one_pair_of_a_frame_is_chosen_and_none_that_gains_nothing() -> None:
    frame = torch.tensor([0, 0, 0, 1, 1, 3, 3])
    gain = torch.tensor([1.0, 2.0, 2.0, -1.0, 0.0, -torch.inf, 0.1])
    assert best_of(gain, frame, 4).nonzero().squeeze(1).tolist() == [1, 6]


@torch.no_grad()
def frames(model: Apex, found: Proposals) -> tuple[Tensor, Tensor]:
    """Six images and what glimpses are cut from; the first three images are as the proposals draw them over grey."""
    x = video(1, 6).double()
    features, _ = model.encoder(x)
    images = x[0]
    for f in range(3):
        cells = present_cells(model, found, f)
        masks, background = drawn(model, cells)
        picture = 0.5 * background.expand_as(images[f])
        for mask, mean in zip(masks, colours(model, cells), strict=True):
            picture = picture + mask * mean
        images[f] = picture
    return images, model.glimpses.sources(x, features)[0][0]


def hand_made(model: Apex, training: bool, present: int = 4) -> Proposals:
    """Proposals of six frames: `present` cells of each are there, and overlap; from frame to frame codes cost more."""
    g = torch.Generator().manual_seed(5)

    def numbers(*shape: int) -> Tensor:
        return torch.randn(6, 16, *shape, dtype=torch.float64, generator=g)

    cost = torch.linspace(0, 4, 6, dtype=torch.float64)[:, None, None]
    q_what = Gaussian(numbers(6) * (0.5 + cost), 0.2 + 0.8 * torch.sigmoid(numbers(6)))
    order = numbers().argsort(1)
    prob = torch.where(order < present, 0.6 + 0.03 * order, 0.1 + 0.02 * order)
    place = torch.cat([-0.5 + 0.3 * numbers(2), 0.4 * numbers(2)], dim=-1)
    what = q_what.mean + q_what.std * numbers(6) if training else q_what.mean
    return Proposals(Gaussian(numbers(4), numbers(4).exp()), q_what, what, place, prob, numbers(model.hidden))


def small_model(shadow: float, over: str = "channel") -> Apex:
    torch.manual_seed(7)
    background = Background(SIZE, 6, 6, shadow=shadow)
    likelihood = MixtureLikelihood(0.2, 0.1, over)  # type: ignore[arg-type]
    return lively(background=background, likelihood=likelihood, render_top=5).double().eval()


Cells = dict[int, tuple[Tensor, Tensor, Tensor]]
"""Mean and standard deviation of z_what, and place, of those cells of a frame that are there."""


def present_cells(model: Apex, found: Proposals, f: int) -> Cells:
    """Those of the likeliest cells of a frame that are there."""
    likeliest = found.prob[f].argsort(descending=True)[: model.render_top].tolist()
    there = [d for d in likeliest if found.prob[f, d] > 0.5]
    return {d: (found.q_what.mean[f, d], found.q_what.std[f, d], found.place[f, d]) for d in there}


def bound(model: Apex, image: Tensor, cells: Cells, backdrops: list[Tensor]) -> float:
    """What a frame's likelihood and codes are worth if these cells are there."""
    masks, background = drawn(model, cells)
    assert isinstance(model.likelihood, MixtureLikelihood)
    means = colours(model, cells)
    worth = naive.log_likelihood(image, [*masks, background], means, backdrops, model.likelihood, SCALES)
    for what, std, _ in cells.values():
        worth -= naive.kl_normal((what, std), (torch.zeros_like(what), torch.ones_like(std)))
    return worth


def colours(model: Apex, cells: Cells) -> list[Tensor]:
    """Images of cells."""
    return [
        naive.paste(torch.sigmoid(model.colour_decoder(what[None])[0]), window_of(place), SIZE)
        for what, _, place in cells.values()
    ]


def drawn(model: Apex, cells: Cells) -> tuple[list[Tensor], Tensor]:
    """Masks of cells that are there and of the background."""
    assert isinstance(model.masks, ApexNormalisation)
    alphas = [naive.mask_logits(model, what) for what, _, _ in cells.values()]
    windows = [window_of(place) for _, _, place in cells.values()]
    there = [torch.ones((), dtype=torch.float64)] * len(alphas)
    masks, _, background = naive.frame_masks(alphas, there, windows, model.masks.c, SIZE)
    return masks, background


def extent(pixels: Tensor) -> tuple[float, float]:
    """Size and centre of the window around the pixels of a line that are seen."""
    seen = [i for i, one in enumerate(pixels.tolist()) if one]
    low, high = seen[0], seen[-1] + 1
    return min(max(1.25 * (high - low) / SIZE, 2 / SIZE), 0.95), (low + high) / SIZE - 1


Union = tuple[int, int, Tensor, Tensor, Tensor, Tensor]
"""Larger and smaller cell; mean and standard deviation of z_what, place and hidden state of both as one."""


@torch.no_grad()
def best_union(model: Apex, image: Tensor, source: Tensor, found: Proposals, f: int) -> tuple[Union | None, int]:
    """The pair of a frame whose union raises the bound most, by trying all that touch; and how many do."""
    cells = present_cells(model, found, f)
    masks, m_bg = drawn(model, cells)
    z = naive.normal(model.background.encoder(torch.cat([m_bg[None], image])[None])[0])[0]
    backdrops = naive.looks(model, naive.decoded(model, z), image)
    before = bound(model, image, cells, backdrops)
    before -= sum(naive.kl_presence(float(found.prob[f, d]), P0) for d in cells)
    by_cell = dict(zip(cells, masks, strict=True))
    owner = torch.stack([m_bg, *masks]).argmax(0)
    region = {d: owner == 1 + k for k, d in enumerate(cells)}
    lengths = {(a, b): rim(by_cell[a], by_cell[b]) for a, b in itertools.combinations(cells, 2)}
    judged = [pair for pair in sorted(lengths, key=lambda pair: -lengths[pair])[:4] if lengths[pair] > 4]
    best, most = None, before
    for pair in judged:
        first, second = sorted(pair, key=lambda d: -float(by_cell[d].sum()))
        pixels = by_cell[first] + by_cell[second] > 0.5
        (s_y, t_y), (s_x, t_x) = extent(pixels.any(1)), extent(pixels.any(0))
        window = torch.tensor([s_y, s_x, t_y, t_x], dtype=torch.float64)
        place = torch.cat([torch.logit(window[:2]), window[2:]])
        code = model.glimpses.glimpse(naive.cut(source, window, model.glimpses.size)[None])[0]
        nothing = torch.zeros(model.hidden, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
        hidden = naive.recur(model.appearance.rnn, nothing[0], code, nothing[1])
        mean, std = naive.normal(model.appearance.head(torch.cat([hidden, code])))
        left = {d: (mean, std, place) if d == first else cell for d, cell in cells.items() if d != second}
        after = bound(model, image, left, backdrops)
        after -= sum(naive.kl_presence(float(found.prob[f, d]), P0) for d in left) + naive.kl_presence(0.0, P0)
        a, b, both = (
            in_tangents(x, owner == 0) for x in (region[first], region[second], region[first] | region[second])
        )
        after += model.piece_price * lengths[pair] - model.hollow_price * (both - a - b)
        if after > most:
            best, most = (first, second, mean, std, place, hidden), after
    return best, len(judged)


def fields(found: Proposals) -> Iterator[tuple[str, Tensor]]:
    """Every tensor of proposals under its name."""
    for name, value in zip(found._fields, found, strict=True):
        if isinstance(value, Gaussian):
            yield from ((f"{name}.{part}", x) for part, x in zip(value._fields, value, strict=True))
        else:
            yield name, value


@pytest.mark.parametrize("training", [False, True], ids=["means", "samples"])
@pytest.mark.parametrize("shadow", [1.0, 0.7])
def test_the_union_that_raises_the_bound_most_against_trying_them_all(shadow: float, training: bool) -> None:
    model = small_model(shadow)
    found = hand_made(model, training)
    images, source = frames(model, found)
    with torch.no_grad():
        after = merged(model, found, images, source, VALUES)
    unions, tried = 0, 0
    want = {name: value.clone() for name, value in fields(found)}
    for f in range(6):
        best, judged = best_union(model, images[f], source[f], found, f)
        tried += judged
        if best is None:
            continue
        unions += 1
        first, second, mean, std, place, hidden = best
        noise = (found.what[f, first] - found.q_what.mean[f, first]) / found.q_what.std[f, first]
        assert (noise != 0).all() if training else (noise == 0).all()
        new = {"q_what.mean": mean, "q_what.std": std, "what": mean + std * noise, "place": place}
        for name, value in (new | {"hidden_what": hidden}).items():
            torch.testing.assert_close(dict(fields(after))[name][f, first], value, rtol=1e-8, atol=1e-8, msg=name)
            want[name][f, first] = dict(fields(after))[name][f, first]
        want["prob"][f, second] = 0.0
        if not training:
            assert torch.equal(after.what[f, first], after.q_what.mean[f, first])
    assert 0 < unions < 6  # in some frames, not in all
    assert tried > 6
    for name, value in fields(after):  # everything else stays, bit for bit
        assert torch.equal(value, want[name]), name


PRICES = ((0.0, 0.0), (5.0, 0.0), (100.0, 0.0), (100.0, 10.0), (100.0, 50.0), (100.0, 100.0))
"""piece_price and hollow_price."""


def test_prices_change_which_pair_becomes_one() -> None:
    model = small_model(1.0)
    found = hand_made(model, training=False)
    images, source = frames(model, found)
    seen = set()
    for model.piece_price, model.hollow_price in PRICES:
        with torch.no_grad():
            after = merged(model, found, images, source, VALUES)
        want = []
        for f in range(6):
            best, _ = best_union(model, images[f], source[f], found, f)
            want.append(None if best is None else best[1])
        gone = [(p == 0).nonzero().squeeze(1).tolist() for p in after.prob]
        assert gone == [[] if cell is None else [cell] for cell in want]
        seen.add(tuple(want))
    assert len(seen) >= 4


@pytest.mark.parametrize("training", [False, True], ids=["means", "samples"])
def test_rounds_are_one_after_the_other(training: bool) -> None:
    model = small_model(0.7)
    model.piece_price = 5.0
    found = hand_made(model, training)
    images, source = frames(model, found)
    with torch.no_grad():
        once = merged(model, found, images, source, VALUES)
        thrice = merged(model, found, images, source, VALUES, rounds=3)
        for _ in range(2):
            once = merged(model, once, images, source, VALUES)
    gone = ((thrice.prob == 0).sum(1)).tolist()
    assert max(gone) > 1
    assert min(gone) < max(gone)
    for (name, a), (_, b) in zip(fields(once), fields(thrice), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12, msg=name)


@pytest.mark.parametrize(("over", "rounds"), [("channel", 1), ("channel", 3), ("pixel", 1)])
@pytest.mark.parametrize("most", [1, 4])
def test_where_nobody_may_look_it_is_the_same(most: int, over: str, rounds: int, static: Callable[[], None]) -> None:
    model = small_model(0.7, over)
    model.piece_price, model.hollow_price = (0.0, 0.0) if rounds == 1 else (50.0, 1.0)
    found = hand_made(model, True)
    images, source = frames(model, found)
    results = []
    for _ in range(2):
        leaves = source.clone().requires_grad_()
        model.zero_grad()
        after = merged(model, found, images, leaves, VALUES, most=most, rounds=rounds)
        sum(value.square().sum() for _, value in fields(after)).backward()  # type: ignore[union-attr]
        weights = [w.grad for part in (model.appearance, model.glimpses.glimpse) for w in part.parameters()]
        results.append(([value for _, value in fields(after)], [leaves.grad, *weights]))
        static()
    assert not torch.equal(results[0][0][5], found.place)
    for looked, not_looked in zip(results[0][0], results[1][0], strict=True):
        torch.testing.assert_close(looked, not_looked, rtol=1e-12, atol=1e-12)
    for looked, not_looked in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(looked, not_looked, rtol=1e-9, atol=1e-11)


def test_gradients_reach_what_reads_the_union_and_no_window() -> None:
    model = small_model(0.7)
    found = hand_made(model, True)
    images, source = frames(model, found)
    leaves = [value.clone().requires_grad_() for _, value in fields(found)]
    where, what, rest = Gaussian(*leaves[:2]), Gaussian(*leaves[2:4]), leaves[4:]
    after = merged(model, Proposals(where, what, *rest), images, source, VALUES)
    gone = (after.prob == 0).nonzero()
    changed = (after.place != found.place).any(-1)
    assert len(gone) == changed.sum() > 0
    sum((value * torch.linspace(1, 2, value.numel()).view_as(value)).sum() for _, value in fields(after)).backward()  # type: ignore[union-attr]
    for name, leaf in zip((name for name, _ in fields(found)), leaves, strict=True):
        assert leaf.grad is not None
        if name == "prob":
            assert (leaf.grad[tuple(gone.T)] == 0).all()
            continue
        moved = torch.zeros_like(changed) if name.startswith("q_where") else changed
        assert (leaf.grad[moved] == 0).all(), name  # what was replaced has nothing to say any more
        assert (leaf.grad[~moved] != 0).any(-1).all(), name
    for part in (model.appearance, model.glimpses.glimpse):
        for name, weight in part.named_parameters():
            used = "weight_hh" not in name  # the hidden state before is zero
            assert weight.grad is not None
            assert bool(weight.grad.abs().sum() > 0) == used, name
    for other in (model.mask_decoder, model.colour_decoder, model.background, model.glimpses.propagation):
        assert all(weight.grad is None for weight in other.parameters())


def test_where_nothing_is_present_nothing_changes(static: Callable[[], None]) -> None:
    model = small_model(1.0)
    images, source = frames(model, hand_made(model, True))
    for present in (0, 1):
        found = hand_made(model, True, present)
        assert merged(model, found, images, source, VALUES) is found
    static()
    for present in (0, 1):
        found = hand_made(model, True, present)
        after = merged(model, found, images, source, VALUES)
        for (name, value), (_, was) in zip(fields(after), fields(found), strict=True):
            assert torch.equal(value, was), name


def test_a_video_in_slices_merges_as_a_whole_one() -> None:
    torch.manual_seed(7)
    model = lively(background=Background(SIZE, 6, 6, shadow=0.7), merges=2).double().eval()
    x = video(2, 6).double()
    with torch.no_grad():
        whole = model(x, Context(SCHEDULE))
        sliced, state = [], None
        for part in x.split((1, 3, 2), dim=1):
            sliced.append(model(part, Context(SCHEDULE, state=state)))
            state = sliced[-1].state
        model.merges = 0
        apart = model(x, Context(SCHEDULE))
    for name in ("masks", "presence", "appearance", "reconstruction", "ids"):
        joined = torch.cat([getattr(scene, name) for scene in sliced], dim=1)
        torch.testing.assert_close(joined, getattr(whole, name), rtol=1e-9, atol=1e-9, msg=name)
    for name, term in whole.terms.items():
        torch.testing.assert_close(sum(scene.terms[name] for scene in sliced), term, rtol=1e-9, atol=1e-9, msg=name)
    assert not torch.equal(whole.ids, apart.ids)  # something has merged

"""Noise does not depend on ranks, batches, order or chunks."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apex_lab.nn.noise import RankNoise, VideoNoise, mixed, number_of
from apex_lab.scene import Noise


def shapes() -> list[Tensor]:
    """Per video, flattened with slots, and one whose memory is not in the order of its dimensions."""
    return [torch.empty(4, 3), torch.empty(4 * 5, 2, 2), torch.empty(4, 7, 6).transpose(1, 2)]


@pytest.mark.parametrize("like", shapes(), ids=lambda x: str(tuple(x.shape)))
@pytest.mark.parametrize("kind", ["normal", "uniform"])
def test_ranks_share_the_numbers_of_one_rank(like: Tensor, kind: str) -> None:
    def draw(first: int, videos: int) -> Tensor:
        torch.manual_seed(3)
        each = len(like) // 4
        noise = RankNoise(videos, first, 4)
        getattr(noise, kind)(like[: videos * each])  # the second draw follows the first
        return getattr(noise, kind)(like[: videos * each])

    whole = draw(0, 4)
    assert whole.shape == like.shape
    torch.testing.assert_close(torch.cat([draw(0, 1), draw(1, 1), draw(2, 2)]), whole, rtol=0, atol=0)


def test_one_rank_draws_what_pytorch_draws() -> None:
    like = torch.empty(4, 7, 6).transpose(1, 2)
    torch.manual_seed(3)
    ours = RankNoise(4, 0, 4).normal(like)
    torch.manual_seed(3)
    assert torch.equal(ours, torch.randn_like(like))


@pytest.mark.parametrize("kind", ["normal", "uniform"])
def test_a_videos_noise_is_its_own(kind: str) -> None:
    like = torch.empty(3, 50)
    together = getattr(VideoNoise(0, [5, 6, 7]), kind)(like)
    alone = [getattr(VideoNoise(0, [video]), kind)(like[:1]) for video in (7, 5, 6)]
    assert torch.equal(together, torch.cat([alone[1], alone[2], alone[0]]))
    assert not torch.equal(together, getattr(VideoNoise(1, [5, 6, 7]), kind)(like))
    assert len({row[0].item() for row in together}) == 3


def test_chunks_get_the_numbers_of_the_whole() -> None:
    def pass_over(noise: Noise, frames: int) -> list[Tensor]:
        """All frames at once, then frame by frame, as a model might draw."""
        at_once = noise.at(0, frames).normal(torch.empty(2 * frames, 3)).unflatten(0, (2, frames))
        steps = [noise.at(t).normal(torch.empty(2, 4)) for t in range(frames)]
        return [at_once, torch.stack(steps, dim=1)]

    whole = pass_over(VideoNoise(0, [1, 2]), 7)
    parts = [pass_over(VideoNoise(0, [1, 2], start), count) for start, count in ((0, 3), (3, 4))]
    for expected, *found in zip(whole, *parts, strict=True):
        assert torch.equal(torch.cat(found, dim=1), expected)


def test_moments() -> None:
    normal = VideoNoise(0, range(20)).normal(torch.empty(20, 5000))
    uniform = VideoNoise(0, range(20)).uniform(torch.empty(20, 5000))
    assert abs(float(normal.mean())) < 0.02
    assert abs(float(normal.std()) - 1) < 0.02
    assert abs(float(uniform.mean()) - 0.5) < 0.01
    assert 0 <= float(uniform.min()) <= float(uniform.max()) < 1


def test_rows_that_cannot_be_split_among_videos_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(5, 2\) cannot be split among 2 videos"):
        VideoNoise(0, [1, 2]).normal(torch.empty(5, 2))
    with pytest.raises(ValueError, match="cannot be split"):
        RankNoise(2, 0, 2).normal(torch.empty(5, 2))


def test_seeds_are_all_different_and_in_range() -> None:
    seeds = {mixed(seed, step) for seed in range(20) for step in range(500)}
    assert len(seeds) == 20 * 500
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert number_of("test_00001") != number_of("test_00002")
    assert 0 <= number_of("test_00001") < 2**63

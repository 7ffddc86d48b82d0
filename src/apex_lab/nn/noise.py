"""Noise whose numbers do not depend on how videos are spread over ranks, batches or chunks (`apex_lab.scene.Noise`)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from apex_lab.scene import Noise

Draw = Callable[..., Tensor]


def mixed(first: int, *parts: int) -> int:
    """A generator seed in [0, 2^63) from several integers; neighbouring integers give unrelated seeds (splitmix64)."""
    mask = 2**64 - 1
    value = first
    for part in parts:
        value = (value * 0x9E3779B97F4A7C15 + part + 1) & mask
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            value = ((value ^ (value >> shift)) * factor) & mask
        value ^= value >> 31
    return value & (2**63 - 1)


def number_of(name: str) -> int:
    """A number in [0, 2^63) for the name of a video, the same on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") >> 1


class RankNoise(Noise):
    """Noise of one rank's videos out of a global batch, drawn from PyTorch's default generator.

    Every rank draws for the global batch and keeps its rows, so N ranks get the numbers of one. The caller seeds the
    generator, equally on all ranks.

    Args:
        videos: of this rank.
        first: position of the rank's first video in the global batch.
        total: videos of the global batch.
    """

    def __init__(self, videos: int, first: int, total: int) -> None:
        self._videos, self._first, self._total = videos, first, total

    def normal(self, like: Tensor) -> Tensor:
        return self._rows(self._global(like).normal_())

    def uniform(self, like: Tensor) -> Tensor:
        return self._rows(self._global(like).uniform_())

    def _global(self, like: Tensor) -> Tensor:
        """An empty tensor for the global batch, in memory as one in the shape of `like` would be."""
        each = rows_each(like, self._videos)
        alone = torch.empty_like(like)
        size, strides = (self._total * each, *like.shape[1:]), alone.stride()
        if any(strides[0] < stride for stride in strides[1:]):  # videos are not slowest in memory
            return torch.empty(size, dtype=like.dtype, device=like.device)
        return torch.empty_strided(size, strides, dtype=like.dtype, device=like.device)

    def _rows(self, whole: Tensor) -> Tensor:
        each = len(whole) // self._total
        return whole[self._first * each : (self._first + self._videos) * each]


class VideoNoise(Noise):
    """Noise that is a function of (seed, video, frame): for evaluation.

    Scores then depend neither on the order of videos nor on the batch, on resumption or on chunks.

    Args:
        seed: of the evaluation.
        videos: a number per video of the batch (`number_of` its name).
        first_frame: index in its video of the pass's first frame.
    """

    def __init__(self, seed: int, videos: Sequence[int], first_frame: int = 0) -> None:
        self._seed, self._videos, self._first_frame = seed, tuple(videos), first_frame
        self._generators: dict[tuple[int, int, str], torch.Generator] = {}

    def normal(self, like: Tensor) -> Tensor:
        return self._draw(torch.randn, like, [-1 - self._first_frame])

    def uniform(self, like: Tensor) -> Tensor:
        return self._draw(torch.rand, like, [-1 - self._first_frame])

    def at(self, frame: int, frames: int = 1) -> Noise:
        return _Frames(self, range(self._first_frame + frame, self._first_frame + frame + frames))

    @torch.compiler.disable  # it would compile anew for the number of every video
    def _draw(self, draw: Draw, like: Tensor, frames: Sequence[int]) -> Tensor:
        """Rows of `like`: videos slowest, then `frames`, then what is left."""
        each = rows_each(like, len(self._videos) * len(frames))
        parts = [
            draw(
                (each, *like.shape[1:]),
                generator=self._generator(video, frame, like.device),
                dtype=like.dtype,
                device=like.device,
            )
            for video in self._videos
            for frame in frames
        ]
        return torch.cat(parts)

    def _generator(self, video: int, frame: int, device: torch.device) -> torch.Generator:
        key = (video, frame, str(device))
        if key not in self._generators:
            seed = mixed(self._seed, video, frame + 2**32)
            self._generators[key] = torch.Generator(device).manual_seed(seed)
        return self._generators[key]


class _Frames(Noise):
    """Some frames of a `VideoNoise`."""

    def __init__(self, noise: VideoNoise, frames: Sequence[int]) -> None:
        self._noise, self._frames = noise, frames

    def normal(self, like: Tensor) -> Tensor:
        return self._noise._draw(torch.randn, like, self._frames)

    def uniform(self, like: Tensor) -> Tensor:
        return self._noise._draw(torch.rand, like, self._frames)


def rows_each(like: Tensor, groups: int) -> int:
    """Rows per group of a tensor whose first dimension is `groups` groups of equal size.

    Raises:
        ValueError: it is not.
    """
    if like.dim() == 0 or like.shape[0] % groups:
        raise ValueError(f"noise in the shape {tuple(like.shape)} cannot be split among {groups} videos or frames")
    return like.shape[0] // groups

"""A model that samples in evaluation gives each video the same scores whatever stands around it."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import default_collate

from apex_lab.inference.predictor import Predictor, joined
from apex_lab.inference.sizes import fitted, fitted_back
from apex_lab.scene import ABSENT, Context, Scene, SceneModel
from tests.tiny import Squares


class Sampling(SceneModel):
    """Masks are noise, drawn in evaluation too; the state counts frames."""

    def forward(self, video: Tensor, context: Context) -> Scene:
        b, t, _, h, w = video.shape
        frames = [context.noise.at(i).normal(video.new_empty(b, 4, h, w)) for i in range(t)]
        masks = torch.stack(frames, dim=1).softmax(dim=2)
        before = torch.zeros(b) if context.state is None else context.state
        ids = torch.arange(4).expand(b, t, 4)
        return Scene(
            masks=masks,
            background=torch.zeros(4, dtype=torch.bool),
            ids=ids,
            presence=torch.ones(b, t, 4),
            appearance=before[:, None, None, None].expand(b, t, 4, 1),
            reconstruction=video,
            terms={},
            state=before + t,
        )


VIDEOS = Squares("test", 5, 6, 16, seed=3)


def predict(indices: list[int], seed: int = 0, chunk: int | None = None, **options: Any) -> Scene:
    predictor = Predictor(Sampling(), {}, torch.device("cpu"), seed=seed, chunk=chunk, **options)
    return predictor(default_collate([VIDEOS[i] for i in indices]))


def test_scores_depend_on_seed_and_video_alone() -> None:
    together = predict([0, 1, 2, 3, 4]).masks
    assert torch.equal(predict([0, 1, 2, 3, 4]).masks, together)
    assert torch.equal(predict([3, 1]).masks, together[[3, 1]])
    assert torch.equal(predict([4]).masks[0], together[4])
    assert not torch.equal(predict([4], seed=1).masks[0], together[4])
    torch.manual_seed(99)
    assert torch.equal(predict([2]).masks[0], together[2])


@pytest.mark.parametrize("chunk", [1, 2, 4, 6, 100])
def test_chunks_give_the_whole(chunk: int) -> None:
    assert torch.equal(predict([0, 1], chunk=chunk).masks, predict([0, 1]).masks)
    assert predict([0], chunk=chunk).state.tolist() == [6]


def test_a_model_that_needs_whole_videos_gets_them() -> None:
    predictor = Predictor(Sampling(), {}, torch.device("cpu"), chunk=2)
    assert predictor.chunk == 2
    model = Sampling()
    model.streams = False
    assert Predictor(model, {}, torch.device("cpu"), chunk=2).chunk is None


class Small(SceneModel):
    """Built for 8 x 8 pixels: the left half is one component."""

    input_size = (8, 8)

    def forward(self, video: Tensor, context: Context) -> Scene:
        assert video.shape[-2:] == (8, 8)
        b, t = video.shape[:2]
        left = (torch.arange(8) < 4).float().expand(b, t, 8, 8)
        masks = torch.stack([left, 1 - left], dim=2)
        return Scene(
            masks=masks,
            background=torch.tensor([False, True]),
            ids=torch.tensor([1, 0]).expand(b, t, 2),
            presence=torch.ones(b, t, 2),
            appearance=torch.zeros(b, t, 2, 1),
            reconstruction=video,
            terms={},
            means=video[:, :, None].expand(b, t, 2, 3, 8, 8) if context.detail else None,
        )


def test_videos_are_resized_to_the_model_and_its_output_back() -> None:
    predictor = Predictor(Small(), {}, torch.device("cpu"))
    scene = predictor(default_collate([VIDEOS[0]]), detail=True)
    assert scene.masks.shape[-2:] == scene.reconstruction.shape[-2:] == (16, 16)
    assert scene.means is not None
    assert scene.means.shape[-2:] == (16, 16)
    torch.testing.assert_close(scene.masks.sum(2), torch.ones(1, 6, 16, 16))
    assert (scene.segmentation()[..., :8] == 1).all()
    assert (scene.segmentation()[..., 8:] == 0).all()
    assert ABSENT not in scene.segmentation()


def test_resizing_is_antialiased_and_keeps_the_range() -> None:
    stripes = torch.zeros(1, 1, 3, 32, 32)
    stripes[..., ::2] = 1
    small = fitted(stripes, (8, 8))
    assert (small - 0.5).abs().max() < 0.1
    assert fitted(stripes, None) is stripes
    assert fitted(stripes, (32, 32)) is stripes
    scene = Small()(torch.rand(1, 1, 3, 8, 8), Context())
    assert fitted_back(scene, (8, 8)) is scene


def test_diagnostics_that_some_chunks_lack_are_means_of_the_others() -> None:
    one, two = (predict([0], chunk=3) for _ in range(2))
    first = dataclasses.replace(one, diagnostics={"both": torch.tensor(1.0)})
    later = dataclasses.replace(two, diagnostics={"both": torch.tensor(3.0), "later": torch.tensor(5.0)})
    whole = joined([first, later])
    assert {name: float(value) for name, value in whole.diagnostics.items()} == {"both": 2.0, "later": 5.0}

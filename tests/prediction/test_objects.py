"""Objects of frames in the frames' own pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from apex_lab.inference.sizes import fitted_back
from apex_lab.prediction.objects import Names, Reader, label_map
from apex_lab.scene import ABSENT, Scene
from apex_lab.videos import Fit, Frame, framing
from tests.prediction.lamps import Lamps, Strangers, segmenter
from tests.videos.made import moving


def read(video: np.ndarray, size: tuple[int, int], fit: Fit = "crop", model: Lamps | None = None) -> list:
    made = segmenter(model, size, fit)
    view = made.framing(video.shape[1:3])
    scene = made.scene_of(np.stack([view.fitted(image) for image in video]))
    reader = Reader(view, made.tracks, 0.5)
    return [reader(scene, t, t, Frame(video[t], t / 10)) for t in range(len(video))]


def test_an_object_has_its_pixels_box_centre_and_area() -> None:
    for predicted in read(moving(12), (48, 48)):  # sees the columns 8 to 55
        t = predicted.number
        [seen] = predicted.objects
        left = max(t, 8)
        right = t + 16  # up to, not including; the square is in the left half
        assert seen.box == (left, 8, right - left, 16)
        assert seen.area == 16 * (right - left)
        assert seen.centre == pytest.approx(((left + right - 1) / 2, 15.5))
        wanted = np.zeros((48, 64), dtype=np.uint8)
        wanted[8:24, left:right] = 1
        wanted[:, :8] = wanted[:, 56:] = 255
        assert np.array_equal(predicted.index, wanted)
        assert predicted.appearance.tolist() == [[t, 1]]


def test_letterbox_sees_everything() -> None:
    [predicted] = read(moving(1), (64, 64), "letterbox")
    assert predicted.objects[0].box == (0, 8, 16, 16)
    assert set(np.unique(predicted.index)) == {0, 1}


def test_boxes_are_those_of_the_large_frame() -> None:
    video = np.full((1, 480, 640, 3), 30, dtype=np.uint8)
    video[:, 80:240, 100:260] = 200
    [predicted] = read(video, (48, 48))
    left, top, width, height = predicted.objects[0].box
    for found, wanted in ((left, 100), (top, 80), (width, 160), (height, 160)):
        assert abs(found - wanted) <= 5  # half a pixel of the model's input


@pytest.mark.parametrize("frame", [(48, 64), (31, 17), (8, 8), (5, 4)])
@pytest.mark.parametrize("fit", ["crop", "letterbox"])
def test_the_winner_is_that_of_the_resized_scene(frame: tuple[int, int], fit: Fit) -> None:
    generator = torch.Generator().manual_seed(0)
    masks = torch.rand(1, 1, 5, 8, 8, generator=generator).softmax(dim=2)
    presence = torch.tensor([[[1, 0.9, 0.2, 1, 0.1]]])
    ids = torch.tensor([[[0, 7, 3, ABSENT, 0]]])
    background = torch.tensor([False, False, False, False, True])
    view = framing(frame, (8, 8), fit)
    there = torch.tensor([True, True, False, False, True]).numpy()
    found = label_map(masks[0, 0].numpy(), there, view)
    scene = Scene(
        masks=view.of_target(masks).contiguous(),
        background=background,
        ids=torch.where(ids == ABSENT, ids, torch.arange(5)),
        presence=presence,
        appearance=torch.zeros(1, 1, 5, 1),
        reconstruction=torch.zeros(1, 1, 3, *view.of_target(masks).shape[-2:]),
        terms={},
    )
    wanted = np.full(frame, -1)
    part = view.source
    wanted[part.slices] = fitted_back(scene, (part.height, part.width)).segmentation()[0, 0].numpy()
    assert (found == wanted).mean() > 0.995  # float rounding may decide a tie


def test_nothing_there_is_background() -> None:
    found = label_map(np.ones((2, 8, 8), dtype=np.float32), np.zeros(2, dtype=bool), framing((8, 8), (8, 8), "crop"))
    assert (found == -2).all()
    [predicted] = read(np.zeros((1, 8, 8, 3), dtype=np.uint8), (8, 8))
    assert predicted.objects == []
    assert (predicted.index == 0).all()


def test_objects_of_models_that_do_not_track_are_linked() -> None:
    video = np.full((6, 48, 48, 3), 30, dtype=np.uint8)
    for t in range(6):
        video[t, 8:24, 16 + t : 32 + t] = 200  # crosses the middle
        if t != 3:
            video[t, 30:40, 2:8] = 200  # is away in one frame
    ids = [[seen.id for seen in predicted.objects] for predicted in read(video, (48, 48), model=Strangers())]
    # component 1 holds the left part of the square and the small one; component 2 the square's right part
    assert ids == [[1, 2]] * 6


def test_ids_count_from_one_and_an_index_is_used_again_only_when_none_is_free() -> None:
    names = Names()
    assert names([40, 7]) == [(1, 1), (2, 2)]
    assert names([7]) == [(2, 2)]
    for identity in range(100, 100 + 252):
        names([7, identity])
    assert not names.reused
    assert names([7, 5000]) == [(2, 2), (255, 1)]  # 40 was not seen for the longest time
    assert names.reused
    again = Names.of(names.stored())
    assert again([40, 7]) == names([40, 7]) == [(1, 3), (2, 2)]
    assert again([100, 351]) == names([100, 351])
    for _ in range(300):
        frame = names([7, 351, 12])
        assert len({index for _, index in frame}) == 3
        assert all(1 <= index <= 254 for _, index in frame)

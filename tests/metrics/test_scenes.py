from __future__ import annotations

import pytest
import torch

from apex_lab.metrics import background_identities, scene_identities
from apex_lab.metrics.scenes import resize_masks
from apex_lab.scene import ABSENT, Scene


def scene(masks: torch.Tensor, ids: list[int], presence: list[float], background: list[bool]) -> Scene:
    b, t, k, h, w = masks.shape
    return Scene(
        masks=masks,
        background=torch.tensor(background),
        ids=torch.tensor(ids).expand(b, t, k),
        presence=torch.tensor(presence).expand(b, t, k),
        appearance=torch.zeros(b, t, k, 1),
        reconstruction=torch.zeros(b, t, 3, h, w),
        terms={},
    )


def three_masks() -> torch.Tensor:
    """One row of four pixels: object 0 wins two, object 1 one, the background (2) one."""
    return torch.tensor(
        [[0.6, 0.4, 0.3, 0.1], [0.1, 0.3, 0.5, 0.2], [0.3, 0.3, 0.2, 0.7]],
    )[None, None, :, None, :]


def test_identity_of_the_winner() -> None:
    found = scene_identities(scene(three_masks(), [5, 8, 0], [1.0, 1.0, 1.0], [False, False, True]))
    assert found.tolist() == [[[[5, 5, 8, 0]]]]


def test_absent_objects_leave_their_pixels_to_the_next_best() -> None:
    found = scene_identities(scene(three_masks(), [5, 8, 0], [0.4, 1.0, 0.0], [False, False, True]))
    assert found.tolist() == [[[[0, 8, 8, 0]]]]


def test_absent_objects_leave_nothing_where_presence_comes_after() -> None:
    absent = scene(three_masks(), [5, 8, 0], [0.4, 1.0, 0.0], [False, False, True])
    assert scene_identities(absent, presence_after=True).tolist() == [[[[9, 9, 8, 0]]]]


def test_background_identities() -> None:
    found = scene(three_masks(), [5, ABSENT, 0], [1.0, 1.0, 1.0], [False, True, True])
    assert background_identities(found) == [{0}]


def test_a_pixel_without_identity_is_refused() -> None:
    with pytest.raises(ValueError, match=r"25\.00% of the pixels were won by a component without an identity"):
        scene_identities(scene(three_masks(), [5, ABSENT, 0], [1.0, 1.0, 1.0], [False, False, True]))


def test_ties_go_to_the_lowest_component() -> None:
    masks = torch.full((1, 1, 2, 1, 1), 0.5)
    assert int(scene_identities(scene(masks, [9, 3], [1.0, 1.0], [False, False]))) == 9


def test_masks_are_resized_before_the_argmax() -> None:
    small = scene(three_masks(), [5, 8, 0], [1.0, 1.0, 1.0], [False, False, True])
    assert scene_identities(small, size=(2, 8)).shape == (1, 1, 2, 8)
    sums = resize_masks(three_masks(), (4, 16)).sum(dim=2)
    torch.testing.assert_close(sums, torch.ones_like(sums))

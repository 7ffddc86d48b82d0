"""Propagation alone: discovery finds a square in the first frame, is switched off, and the square is followed exactly.

The whole loop over time runs; only the networks are stood in for, by ones that say the true latents.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from apex_lab.models.apex import Apex, ScalorNormalisation
from apex_lab.models.apex.masks import MaskNormalisation
from apex_lab.nn.spatial_transformer import pixel_centres
from apex_lab.scene import Context, Scene, schedule_at
from tests.models.apex.small import SIZE, tiny

FRAMES, SIDE, STEP = 6, 8, 2
ROWS = slice(8, 16)
SURE = 14.0
"""Logit of what is certain."""


def square(t: int) -> slice:
    """Columns of the square: it moves two pixels to the right a frame."""
    return slice(4 + STEP * t, 4 + STEP * t + SIDE)


def moving_square() -> tuple[Tensor, Tensor]:
    """A red square on grey, (1, T, 3, H, W), and its true mask, (T, H, W)."""
    x, truth = torch.full((1, FRAMES, 3, SIZE, SIZE), 0.5), torch.zeros(FRAMES, SIZE, SIZE, dtype=torch.bool)
    for t in range(FRAMES):
        truth[t, ROWS, square(t)] = True
        x[0, t, :, truth[t]] = torch.tensor([[1.0], [0.0], [0.0]])
    return x, truth


class Says(nn.Module):
    """Stands in for a network: the same output whatever comes in, of the shape that the network would give."""

    def __init__(self, values: Tensor, channels: bool = False) -> None:
        super().__init__()
        self.values, self.channels = values, channels

    def forward(self, inputs: Tensor) -> Tensor:
        if self.channels:  # a 1 x 1 convolution
            return self.values[None, :, None, None].expand(len(inputs), -1, *inputs.shape[2:])
        return self.values.expand(*inputs.shape[:-1], *self.values.shape)


class OnlyIn(nn.Module):
    """Stands in for p_proposal: sure of one cell in the first frame, and of none ever after."""

    def __init__(self, cell: int, cells: int) -> None:
        super().__init__()
        self.cell, self.cells = cell, cells

    def forward(self, evidence: Tensor) -> Tensor:
        logits = torch.full((*evidence.shape[:-1], 1), -SURE)
        logits[0, self.cell] = SURE
        return logits


def certain(mean: list[float]) -> Tensor:
    """A Gaussian head's output for these means and next to no spread."""
    return torch.tensor([*mean, *[-40.0] * len(mean)])


def ideal(masks: MaskNormalisation | None = None, stop_at: int | None = None) -> Apex:
    """APEX that knows the square: where it is found, how it moves, that it stays, and what it looks like."""
    model = tiny(start_size=0.25, **({"masks": masks} if masks else {}))
    # Discovery: the cell whose centre is nearest to the square's, and the way from there to it.
    top, left = (2 * (ROWS.start + SIDE / 2) / SIZE - 1), (2 * (square(0).start + SIDE / 2) / SIZE - 1)
    axis = pixel_centres(4, torch.zeros(())).tolist()
    row, column = (min(range(4), key=lambda i, at=at: abs(axis[i] - at)) for at in (top, left))
    reach = model.discovery.windows.reach
    away = [math.atanh((top - axis[row]) / reach), math.atanh((left - axis[column]) / reach)]
    size = 4 * math.atanh(math.log(0.25 / 0.75) / 4)  # a quarter of the image, through the soft bound
    model.discovery.head_where = Says(certain([size, size, *away]), channels=True)  # type: ignore[assignment]
    model.discovery.head_pres = OnlyIn(4 * row + column, 16)  # type: ignore[assignment]
    # Propagation: two pixels to the right, and there with certainty.
    moved = math.atanh(STEP * 2 / SIZE / model.propagation.windows.centre_step)
    model.propagation.head_where = Says(certain([0.0, 0.0, 0.0, moved]))  # type: ignore[assignment]
    model.propagation.head_pres = Says(torch.tensor([SURE]))  # type: ignore[assignment]
    # Appearance: a solid red square.
    model.mask_decoder = Says(torch.full((1, 8, 8), 10.0))  # type: ignore[assignment]
    red = torch.tensor([10.0, -10.0, -10.0])[:, None, None].expand(3, 8, 8)
    model.colour_decoder = Says(red)  # type: ignore[assignment]
    return model


def follow(model: Apex, x: Tensor) -> Scene:
    return model(
        x,
        Context(
            schedule_at(
                {
                    "temperature": 0.1,
                    "discovery_presence": 1e-3,
                    "carry": 1.0,
                    "discover": 0.0,
                    "sigma_fg_scale": 1.0,
                    "sigma_bg_scale": 1.0,
                }
            ),
            detail=True,
        ),
    )


@pytest.mark.parametrize("masks", [None, ScalorNormalisation()])
@pytest.mark.parametrize("training", [False, True])
def test_a_square_found_in_the_first_frame_is_followed_exactly(training: bool, masks: MaskNormalisation | None) -> None:
    x, truth = moving_square()
    torch.manual_seed(0)
    scene = follow(ideal(masks).train(training), x)
    assert scene.ids[0].tolist() == [[1, -1, -1, 0]] * FRAMES
    assert torch.equal(scene.segmentation()[0] == 1, truth)
    assert torch.equal(scene.masks[0, :, 0] > 0.5, truth)
    assert (scene.presence[0, :, 0] > 0.99).all()
    window = scene.windows
    assert window is not None
    for t in range(FRAMES):
        centre = [2 * (ROWS.start + SIDE / 2) / SIZE - 1, 2 * (square(t).start + SIDE / 2) / SIZE - 1]
        tolerance = 5e-3 if training else 1e-5  # in training, samples with the smallest standard deviation, 1e-3
        torch.testing.assert_close(window[0, t, 0], torch.tensor([0.25, 0.25, *centre]), rtol=0, atol=tolerance)
    inner = truth.clone()  # the window's outermost pixels are half covered
    inner[:, [ROWS.start, ROWS.stop - 1]] = False
    for t in range(FRAMES):
        inner[t, :, [square(t).start, square(t).stop - 1]] = False
    assert (scene.masks[0, :, 0][inner] > 0.99).all()
    assert ((scene.reconstruction - x)[0].abs().amax(1)[inner] < 0.01).all()
    assert scene.diagnostics["propagated_share"] == pytest.approx((FRAMES - 1) / FRAMES)


def test_without_propagation_the_square_is_lost_in_the_second_frame() -> None:
    """The test above is about propagation: with the square's presence denied, nothing else finds it."""
    x, truth = moving_square()
    model = ideal().eval()
    model.propagation.head_pres = Says(torch.tensor([-SURE]))  # type: ignore[assignment]
    scene = follow(model, x)
    assert torch.equal(scene.segmentation()[0, 0] == 1, truth[0])
    assert (scene.ids[0, 1:, :3] == -1).all()
    assert (scene.segmentation()[0, 1:] == 0).all()


def test_a_square_that_stands_still_needs_no_change() -> None:
    """A latent change of zero leaves window and mask as they are, to the last bit."""
    x, truth = moving_square()
    model = ideal().eval()
    model.propagation.head_where = Says(certain([0.0] * 4))  # type: ignore[assignment]
    scene = follow(model, x[:, :1].expand(-1, FRAMES, -1, -1, -1))
    assert (scene.masks == scene.masks[:, :1]).all()
    assert torch.equal(scene.segmentation()[0] == 1, truth[:1].expand(FRAMES, -1, -1))

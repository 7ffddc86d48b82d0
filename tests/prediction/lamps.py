"""A model whose answers are known: the bright pixels of a frame are an object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apex_lab.inference.predictor import Predictor
from apex_lab.inference.segmenter import Segmenter
from apex_lab.prediction.work import Weights
from apex_lab.scene import ABSENT, Context, Scene, SceneModel
from apex_lab.videos import Fit

WEIGHTS = Weights(Path("lamps.ckpt"), "0" * 64)


class Lamps(SceneModel):
    """Component 0 is the background, 1 the left and 2 the right half's pixels with red above 0.5.

    An object's identity is the number of the frame in which the half became bright, times 2, plus its half; `state` is
    the frame's number and what the halves are called. Appearance: the number of the frame, and the half.
    """

    def forward(self, video: Tensor, context: Context) -> Scene:
        b, t, _, h, w = video.shape
        assert b == 1
        now, called = (0, torch.full((2,), ABSENT)) if context.state is None else context.state
        called = called.clone()
        bright = video[0, :, 0] > 0.5
        right = (torch.arange(w) >= w // 2).expand(h, w)
        masks = torch.stack([~bright, bright & ~right, bright & right], dim=1).float()
        ids = torch.zeros(1, t, 3, dtype=torch.long)
        for frame in range(t):
            for half in range(2):
                seen = bool(masks[frame, 1 + half].any())
                if not self.tracks:
                    called[half] = 1 + half if seen else ABSENT
                elif not seen:
                    called[half] = ABSENT
                elif called[half] == ABSENT:
                    called[half] = 2 * (now + frame) + half + 2
            ids[0, frame, 1:] = called
        numbers = torch.arange(now, now + t, dtype=torch.float32)
        return Scene(
            masks=masks[None],
            background=torch.tensor([True, False, False]),
            ids=ids,
            presence=(ids != ABSENT).float(),
            appearance=torch.stack([numbers[:, None].expand(t, 3), torch.arange(3.0).expand(t, 3)], dim=-1)[None],
            reconstruction=video,
            terms={},
            state=(now + t, called),
        )


class Strangers(Lamps):
    """Does not track."""

    tracks = False


class Patient(Lamps):
    """Needs the whole video at once."""

    streams = False


def segmenter(
    model: SceneModel | None = None, size: tuple[int, int] = (48, 48), fit: Fit = "crop", **more: Any
) -> Segmenter:
    """The model for any video."""
    return Segmenter(Predictor(model or Lamps(), {}, torch.device("cpu")), size, fit, **more)

"""APEX's scene encoder: DLA per frame, then a ConvLSTM over time, stride 4 (apex_paper, "Feature Extraction").

Two shortcuts, which the paper neither names nor rules out, let objects' colours reach z_what within hundreds of steps
instead of thousands: the image itself, averaged to stride 4, joins the DLA's last sum, and the ConvLSTM adds to what
it is given, since its gates would otherwise squash every feature.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch.nn.functional as F
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.nn.conv_lstm import ConvLSTM
from apex_lab.nn.dla import DLA

Count = Annotated[int, Field(gt=0)]


class ApexEncoder(nn.Module):
    """Video -> feature maps e_t that see all frames up to t.

    Args:
        features: F.
        widths: channels of the DLA's six levels (strides 1, 2, 4, 8, 16, 32).
        depths: depths of its four aggregation trees.
        shortcuts: whether there are the two above; without them e_t is the hidden state of the ConvLSTM.
    """

    stride = 4

    def __init__(
        self, features: Count, widths: Sequence[Count], depths: Sequence[Count], shortcuts: bool = True
    ) -> None:
        super().__init__()
        self.features = features
        self.dla = DLA(features, widths, depths)
        self.colour = nn.Conv2d(3, features, 1, bias=False) if shortcuts else None
        if self.colour is not None:
            nn.init.normal_(self.colour.weight)
        self.over_time = ConvLSTM(features)

    def of_images(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N F H/4 W/4"]:
        """RGB in [0, 1] -> features of each frame by itself."""
        centred = images - 0.5
        if self.colour is None:
            return self.dla(centred)
        return self.dla(centred) + self.colour(F.avg_pool2d(centred, self.stride))

    def forward(
        self, video: Float[Tensor, "B T 3 H W"], state: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Float[Tensor, "B T F H/4 W/4"], tuple[Tensor, Tensor]]:
        """RGB in [0, 1] -> features, and the ConvLSTM's state after the last frame.

        The DLA sees all B T frames as one batch.
        """
        frames = self.of_images(video.flatten(0, 1)).unflatten(0, video.shape[:2])
        hidden, state = self.over_time(frames, state)
        return hidden if self.colour is None else frames + hidden, state

"""The contract between models and everything else: `SceneModel` (what a model is) and `Scene` (what it says).

Legend used across the package: B videos, T frames, K components, P propagated slots, D discovery cells,
H, W image height and width, A length of the appearance vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor, nn

ABSENT = -1
"""Identity of a component that holds nothing in a frame."""

Schedule = Mapping[str, Tensor]
"""Values that depend on training progress (temperature, prior, ...), evaluated at one step: name -> 0-dim tensor."""


@dataclass(frozen=True)
class Scene:
    """What a model says about a batch of videos.

    Attributes:
        masks: soft masks in [0, 1], sum to 1 over K at every pixel; an absent component's mask is zero.
        background: which components are background; all False for models that make no difference.
        ids: the same number is the same object over time; `ABSENT` (-1) where a component holds nothing. A background
            component has an id of its own. Ids need only be unique within a video.
        presence: in [0, 1].
        appearance: what the arrangement task matches by (z_what).
        reconstruction: RGB in [0, 1].
        terms: loss terms, one value per video (summed over its frames), each under its own name; the objective to
            minimise is their weighted sum.
        windows: z_where per component as (s_y, s_x, t_y, t_x): size as a share of the image side, centre in [-1, 1];
            NaN where a component has no window. None for models without windows.
        means: each component's own RGB picture in [0, 1], before masking; None where a model has none or where it was
            not asked for.
        diagnostics: name -> 0-dim tensor worth a curve (live objects, mean window size, ...); never part of the loss.
    """

    masks: Float[Tensor, "B T K H W"]
    background: Bool[Tensor, " K"]
    ids: Int[Tensor, "B T K"]
    presence: Float[Tensor, "B T K"]
    appearance: Float[Tensor, "B T K A"]
    reconstruction: Float[Tensor, "B T 3 H W"]
    terms: dict[str, Float[Tensor, " B"]]
    windows: Float[Tensor, "B T K 4"] | None = None
    means: Float[Tensor, "B T K 3 H W"] | None = None
    diagnostics: dict[str, Tensor] = field(default_factory=dict)

    def segmentation(self, min_presence: float = 0.5) -> Int[Tensor, "B T H W"]:
        """Identity of the winning component at every pixel (metrics.md sections 0 and 2.4).

        Object components with a presence below `min_presence` are taken out before the argmax, so their pixels go to
        the next best mask. Ties go to the lowest component.
        """
        masks = self.masks.float()
        absent = (self.presence < min_presence) & ~self.background | (self.ids == ABSENT)
        winner = masks.masked_fill(absent[..., None, None], -1.0).argmax(dim=2)
        ids = self.ids[..., None, None].expand(*masks.shape)
        return ids.gather(2, winner[:, :, None]).squeeze(2)


class SceneModel(nn.Module):
    """A plain module from videos to a `Scene`: knows no trainer, logger, file or step counter.

    In training mode latents are sampled; in evaluation mode the result is deterministic.
    """

    needs_training: bool = True
    """False for models that have nothing to learn by gradient (the classical yardsticks)."""

    tracks: bool = True
    """False for models of single images, whose ids mean nothing from one frame to the next: no tracking scores."""

    needs_labels: bool = False
    """True for models that read the ground truth (the oracle): `from_labels` takes the place of `forward`."""

    has_posterior: bool = False
    """True for models whose likelihood is a mixture over components, so that `posterior` can be asked."""

    def initialise(self, median: Float[Tensor, "3 H W"]) -> None:
        """Called once before training starts from scratch, with the training set's per-pixel median in [0, 1].

        The default ignores it.
        """

    def forward(self, video: Float[Tensor, "B T 3 H W"], schedule: Schedule) -> Scene:
        """RGB video in [0, 1] and the scheduled values at this step -> `Scene`."""
        raise TypeError(f"{type(self).__name__} does not define forward(video, schedule)")

    def posterior(
        self, scene: Scene, video: Float[Tensor, "B T 3 H W"], schedule: Schedule
    ) -> Float[Tensor, "B T K H W"]:
        """How likely each component is to have drawn each pixel, given the pixel; sums to 1 over K.

        `Scene.masks` are the mixing weights before the pixel is seen; these are the weights after (its
        responsibilities).

        Args:
            scene: of this video, from this model in evaluation mode.
            video: RGB in [0, 1].
            schedule: as it was for the scene.
        """
        raise TypeError(f"{type(self).__name__} has no mixture likelihood, so no posterior over components")

    def from_labels(self, video: Float[Tensor, "B T 3 H W"], segmentation: Integer[Tensor, "B T H W"]) -> Scene:
        """RGB video in [0, 1] and its ground truth -> `Scene`; called in place of `forward` where `needs_labels`."""
        raise TypeError(f"{type(self).__name__} does not read the ground truth: call forward(video, schedule)")


def schedule_at(values: Mapping[str, float], device: torch.device | str = "cpu") -> dict[str, Tensor]:
    """Wraps plain numbers as the 0-dim tensors that `SceneModel.forward` takes."""
    return {name: torch.tensor(float(value), device=device) for name, value in values.items()}

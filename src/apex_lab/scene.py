"""The contract between models and everything else: `SceneModel` (a model), `Context` (its input besides pixels) and
`Scene` (its output).

Legend used across the package: B videos, T frames, K components, P propagated slots, D discovery cells,
H, W image height and width, A length of the appearance vector.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor, nn

ABSENT = -1
"""Identity of a component that holds nothing in a frame."""

BACKGROUND_ID = 0
"""Identity of the background where a model has one; its objects count from 1."""

Schedule = Mapping[str, Tensor]
"""Values that depend on training progress (temperature, prior, ...), evaluated at one step: name -> 0-dim tensor."""


class Noise:
    """Source of random numbers for a forward pass; this one draws from PyTorch's default generator.

    The first dimension of `like` is the batch of videos, or the batch flattened with dimensions that follow it (time,
    slots), videos slowest: B, B T, B K, B T K, ... Then training noise can be a function of the position of a video in
    the global batch, and evaluation noise a function of the video (`apex_lab.nn.noise`).
    """

    def normal(self, like: Tensor) -> Tensor:
        """Standard normal numbers in the shape, type and device of `like`."""
        return torch.randn_like(like)

    def uniform(self, like: Tensor) -> Tensor:
        """Uniform numbers in [0, 1) in the shape, type and device of `like`."""
        return torch.rand_like(like)

    def at(self, frame: int, frames: int = 1) -> Noise:
        """The noise of `frames` frames from `frame` on, counted from the first frame of the pass.

        A model that samples in evaluation draws frame by frame through this, so that a video cut into chunks gets the
        same numbers as a whole one: `noise.at(t).normal(like)` in the loop over time, or `noise.at(0, T).normal(like)`
        with `like` (B T, ...) for all frames at once.
        """
        return self


@dataclass(frozen=True)
class Context:
    """Everything that a forward pass needs besides pixels.

    Attributes:
        schedule: scheduled values at this step, name -> 0-dim tensor on the model's device.
        noise: random numbers.
        state: `Scene.state` of the frames before; None at the start of a video.
        detail: fill `Scene.windows`, `Scene.means` and other costly fields.
        unused: those of the model's `optional_terms` that nobody reads, which need not be in `Scene.terms`.
    """

    schedule: Schedule = field(default_factory=dict)
    noise: Noise = field(default_factory=Noise)
    state: Any = None
    detail: bool = False
    unused: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Scene:
    """The output of a model for a batch of videos.

    Attributes:
        masks: soft masks in [0, 1], sum to 1 over K at every pixel; an absent component's mask is zero.
        background: which components are background; all False for models that make no difference.
        ids: the same number is the same object over time; `ABSENT` (-1) where a component holds nothing. A background
            component has an id of its own. Ids need only be unique within a video.
        presence: in [0, 1].
        appearance: what the arrangement task matches by (z_what, or the slot).
        reconstruction: RGB in [0, 1].
        terms: loss terms, one value per video (summed over its frames), each under its own name; the objective to
            minimise is their weighted sum.
        terms_weight: for models whose terms are weighted means over the pass: the sum of its weights, by which terms
            of consecutive chunks of a video are averaged. None: terms are sums, which add up over chunks.
        windows: z_where per component as (s_y, s_x, t_y, t_x): size as a share of the image side, centre in [-1, 1];
            NaN where a component has no window. None for models without windows, and without `Context.detail`.
        means: each component's own RGB image in [0, 1], before masking; None for models without, and without
            `Context.detail`.
        diagnostics: name -> 0-dim tensor worth a curve (live objects, mean window size, ...); never part of the loss.
        state: `Context.state` for the next chunk of the same videos; None for models of single images.
    """

    masks: Float[Tensor, "B T K H W"]
    background: Bool[Tensor, " K"]
    ids: Int[Tensor, "B T K"]
    presence: Float[Tensor, "B T K"]
    appearance: Float[Tensor, "B T K A"]
    reconstruction: Float[Tensor, "B T 3 H W"]
    terms: dict[str, Float[Tensor, " B"]]
    terms_weight: float | None = None
    windows: Float[Tensor, "B T K 4"] | None = None
    means: Float[Tensor, "B T K 3 H W"] | None = None
    diagnostics: dict[str, Tensor] = field(default_factory=dict)
    state: Any = None

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


class Statistics:
    """Statistics of the training videos, each computed when it is asked for.

    Args:
        median: computes the per-pixel median image.
    """

    def __init__(self, median: Callable[[], Float[Tensor, "3 H W"]]) -> None:
        self._median = median

    @cached_property
    def median(self) -> Float[Tensor, "3 H W"]:
        """Per-pixel median of the training frames, RGB in [0, 1], at the model's input size."""
        return self._median()


class SceneModel(nn.Module):
    """A plain module from videos to a `Scene`: knows no trainer, logger, file or step counter.

    In training mode latents are sampled. In evaluation mode the result is a function of the weights, the video and
    `Context.noise`. Gradients may be off (`no_grad`, never `inference_mode`): a model that differentiates inside its
    inference opens `torch.enable_grad` itself.
    """

    term_names: ClassVar[tuple[str, ...]] = ()
    """Names of the loss terms in `Scene.terms`."""

    optional_terms: ClassVar[tuple[str, ...]] = ()
    """Those of `term_names` that a configuration may leave out; their weight is 0 then."""

    schedule_ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Scheduled values that `forward` reads: name -> smallest and largest allowed value."""

    optional_schedules: ClassVar[tuple[str, ...]] = ()
    """Those of `schedule_ranges` that a configuration may leave out."""

    evaluates_at_end: bool = False
    """True: validation and evaluation call the model with the values that its schedules end with, whatever the step."""

    needs_training: bool = True
    """False for models that have nothing to learn by gradient (the classical yardsticks)."""

    tracks: bool = True
    """False for models of single images, whose ids mean nothing from one frame to the next: no tracking scores."""

    streams: bool = True
    """False for models that need the whole video at once: `Context.state` is not supported."""

    needs_labels: bool = False
    """True for models that read the ground truth (the oracle): `from_labels` takes the place of `forward`."""

    has_posterior: bool = False
    """True for models whose likelihood is a mixture over components, so that `posterior` can be called."""

    batch_statistics: bool = False
    """True for models that normalise over the batch in training, or draw for it: a result depends on other videos."""

    capturable: bool = True
    """False for models whose operations follow scheduled values: no CUDA graph holds all their steps of training."""

    input_size: tuple[int, int] | None = None
    """(H, W) in pixels for a model built for one size: videos are resized to it, masks back. None: any size."""

    changeable: ClassVar[tuple[str, ...]] = ()
    """Arguments of the constructor that no weight depends on: a trained model can be built with others."""

    def initialise(self, statistics: Statistics) -> None:
        """Called once before training starts from scratch. The default does nothing."""

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """RGB video in [0, 1] -> `Scene`."""
        raise TypeError(f"{type(self).__name__} does not define forward(video, context)")

    def posterior(
        self, scene: Scene, video: Float[Tensor, "B T 3 H W"], context: Context
    ) -> Float[Tensor, "B T K H W"]:
        """How likely each component is to have drawn each pixel, given the pixel; sums to 1 over K.

        `Scene.masks` are the mixing weights before the pixel is seen; these are the weights after (its
        responsibilities).

        Args:
            scene: of this video, from this model in evaluation mode, with `Context.detail`.
            video: RGB in [0, 1].
            context: as it was for the scene.
        """
        raise TypeError(f"{type(self).__name__} has no mixture likelihood, so no posterior over components")

    def from_labels(
        self,
        video: Float[Tensor, "B T 3 H W"],
        segmentation: Integer[Tensor, "B T H W"],
        context: Context | None = None,
    ) -> Scene:
        """RGB video in [0, 1] and its ground truth -> `Scene`; called in place of `forward` where `needs_labels`."""
        raise TypeError(f"{type(self).__name__} does not read the ground truth: call forward(video, context)")


def schedule_at(values: Mapping[str, float], device: torch.device | str = "cpu") -> dict[str, Tensor]:
    """Wraps plain numbers as the 0-dim tensors of `Context.schedule`."""
    return {name: torch.tensor(float(value), device=device) for name, value in values.items()}

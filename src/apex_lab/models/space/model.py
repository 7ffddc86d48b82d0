"""SPACE: the model (Lin et al. 2020; space.md)."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from apex_lab.models.space.background import Background
from apex_lab.models.space.foreground import Foreground
from apex_lab.models.space.likelihood import log_likelihood
from apex_lab.models.space.result import Found, scene_of
from apex_lab.scene import Context, Scene, SceneModel

Count = Annotated[int, Field(gt=0)]
Positive = Annotated[float, Field(gt=0)]


class Space(SceneModel):
    """Spatial attention for objects on a grid, scene mixture for the background; single images.

    Samples latents in evaluation too, as published. BatchNorm in the background makes training, but not evaluation,
    depend on which images share a batch.

    Args:
        image_size: H = W in pixels, a power of two from 32 on; published: 128.
        grid: G; the foreground has G^2 cells. An 8th, 16th or 32nd of `image_size`: 16, 8 or 4 at 128 pixels.
        components: K of the background.
        sigma_fg, sigma_bg: standard deviations of the likelihood, in units of RGB in [0, 1].
        scale_std: standard deviation of the prior of z_scale (before its sigmoid).
        glimpse_size: side of the glimpses in pixels; published: 32.
        what: length of z_what.
        mask, component: lengths of the background's z_m and z_c.
        features: length of the background's image code.
        hidden: of the background's LSTM cells and component prior.
        decoder_width: channels of the background's component decoder (K > 1).
    """

    term_names = ("nll", "kl_pres", "kl_depth", "kl_where", "kl_what", "kl_mask", "kl_component", "boundary")
    schedule_ranges: ClassVar = {
        "temperature": (0.01, 100.0),
        "presence_prior": (0.0, 1.0),
        "scale_prior": (-10.0, 10.0),
        "fix_alpha": (0.0, 1.0),
        "fixed_alpha": (0.0, 1.0),
    }
    tracks = False
    evaluates_at_end = True  # as the published evaluation (space.md section 8)
    batch_statistics = True  # BatchNorm in the background

    def __init__(
        self,
        image_size: Annotated[int, Field(ge=32)] = 128,
        grid: Count = 8,
        components: Count = 5,
        sigma_fg: Positive = 0.15,
        sigma_bg: Positive = 0.15,
        scale_std: Positive = 0.1,
        glimpse_size: Literal[16, 32] = 32,
        what: Count = 32,
        mask: Count = 32,
        component: Count = 32,
        features: Count = 64,
        hidden: Count = 64,
        decoder_width: Count = 32,
    ) -> None:
        super().__init__()
        if image_size < 32 or not math.log2(image_size).is_integer():
            raise ValueError(f"model.image_size={image_size} must be a power of two from 32 on, such as 64 or 128")
        self.image_size, self.sigma_fg, self.sigma_bg = image_size, sigma_fg, sigma_bg
        self.input_size = (image_size, image_size)
        self.foreground = Foreground(image_size, grid, glimpse_size, what, scale_std)
        self.background = Background(image_size, components, mask, component, features, hidden, decoder_width)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Explains every frame by itself.

        Args:
            video: RGB in [0, 1].
            context: its schedule has `temperature` of the relaxed Bernoulli; `presence_prior` p and `scale_prior`, the
                mean of z_scale's prior; `fix_alpha`, 1 while the foreground's mixing weight in the likelihood is the
                constant `fixed_alpha`, else 0. State is not used.
        """
        if video.shape[-2:] != (self.image_size, self.image_size):
            size = tuple(video.shape[-2:])
            raise ValueError(
                f"the model was built for {self.image_size} px images, the video has {size}: "
                f"set model.image_size={size[-1]}"
            )
        images = video.flatten(0, 1)
        noise = context.noise.at(0, video.shape[1])
        cells, terms = self.foreground.infer(images, context.schedule, noise)
        drawn = self.foreground.draw(cells)
        layers, background_terms = self.background(images, noise)
        alpha, mean = drawn.composition.alpha, drawn.composition.mean
        # Warm-up (section 6): KLs, boundary loss and masks keep the real alpha.
        mixing = torch.where(context.schedule["fix_alpha"] > 0.5, context.schedule["fixed_alpha"], alpha)
        likelihood = log_likelihood(images, mixing, mean, layers.masks, layers.means, self.sigma_fg, self.sigma_bg)
        boundary = self.foreground.boundary(cells, drawn)
        terms = {"nll": -likelihood, **terms, **background_terms, "boundary": boundary}
        backdrop = (layers.masks[:, :, None] * layers.means).sum(1)
        reconstruction = mixing[:, None] * mean + (1 - mixing[:, None]) * backdrop
        summed = {name: term.unflatten(0, video.shape[:2]).sum(1) for name, term in terms.items()}
        found = Found(cells, drawn, backdrop, reconstruction)
        return scene_of(found, summed, len(video), context.detail)

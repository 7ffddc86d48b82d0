"""SCALOR: scalable object-oriented representation (Jiang et al. 2020; scalor.md)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from apex_lab.models.scalor.background import Background, DecoderKind
from apex_lab.models.scalor.composition import Layers, clamped, log_likelihood
from apex_lab.models.scalor.encoder import VideoEncoder
from apex_lab.models.scalor.latents import GUARD, full_precision
from apex_lab.models.scalor.objective import Terms, added, discovery_terms, propagation_terms
from apex_lab.models.scalor.recompute import Level, Recompute
from apex_lab.models.scalor.rendering import render
from apex_lab.models.scalor.result import (
    Frame,
    Readout,
    Untracked,
    diagnostics,
    frame_masks,
    frame_means,
    shown_windows,
)
from apex_lab.models.scalor.rollout import ObjectNetworks, State, Step
from apex_lab.models.scalor.windows import AnchoredSize, SizeRule
from apex_lab.nn.distributions import kl_gaussian
from apex_lab.scene import BACKGROUND_ID, Context, Noise, Scene, SceneModel

Count = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


class Rendered(NamedTuple):
    """A video as it is rendered.

    foreground (B, T, H, W): A. backdrop (B, T, 3, H, W): the background's image. image (B, T, 3, H, W): the
    reconstruction; RGB in [0, 1].
    """

    foreground: Tensor
    backdrop: Tensor
    image: Tensor


class Scalor(SceneModel):
    """SCALOR: objects are discovered in a grid of cells and propagated from frame to frame.

    Args:
        image_size: H = W in pixels; 64 and 128 are published, 32 is for tests.
        grid: G; discovery has G^2 cells. 4 and 8 are published.
        glimpse_size: side of glimpses in pixels; 32 and 64 are published.
        what, background: lengths of z_what and z_bg.
        size: rule of a box's size; null: the published one, upright boxes of the size of a pedestrian.
        sigma: standard deviation of a pixel's likelihood.
        max_objects: P, objects that a video can carry. In training, the weakest discoveries beyond it are cut off and
            not rendered either, as published.
        evaluation_objects: P in evaluation, where the weakest discoveries that find no slot are rendered, but not
            carried on; null: as `max_objects`. The original sets no limit.
        track: a discovery with a presence above this is carried on.
        stop: an object whose absence, summed over its life, reaches this is deleted.
        background_decoder: "weak" draws smooth backgrounds only, for data where the background explains everything.
        latents: in evaluation, "samples" as published, or "means", with presence = [probability > 1/2].
        readout: from the rendered layers to masks; see `result.frame_masks`.
        untracked: in the masks, discoveries that are rendered but not carried on count as "background", or are
            "dropped": see `result.frame_masks`.
        recompute: activations that are computed again in the backward pass instead of being kept: "nothing";
            "objects": of the glimpse decoder and the composition; "everything": of the glimpse encoder and the
            background too. Costs time for memory (README.md), changes no result. In float32 on a CPU the composition
            keeps nothing at any level, and the glimpse decoder one map of each layer, but at "everything" none.
    """

    term_names = ("nll", "kl_what", "kl_where", "kl_depth", "kl_pres", "kl_background")
    schedule_ranges: ClassVar = {
        "temperature": (0.01, 100.0),
        "discovery_presence": (0.0, 1.0),
        "slot_gradient": (0.0, 1.0),
        "alpha_curriculum": (0.0, 1.0),
    }
    """temperature: of the relaxed Bernoulli. discovery_presence: prior probability of a new object per cell.
    slot_gradient: above 1/2, gradients flow from frame to frame through objects. alpha_curriculum: above 1/2, every
    proposal's mask counts as 0.9 in the foreground's mask, which silences the background."""

    def __init__(
        self,
        image_size: Literal[32, 64, 128] = 128,
        grid: Count = 8,
        glimpse_size: Literal[16, 32, 64] = 64,
        what: Count = 64,
        background: Count = 10,
        size: SizeRule | None = None,
        sigma: Positive = 0.1,
        max_objects: Count = 45,
        evaluation_objects: Count | None = None,
        track: Share = 0.7,
        stop: Positive = 0.6,
        background_decoder: DecoderKind = "strong",
        latents: Literal["samples", "means"] = "samples",
        readout: Readout = "rendering",
        untracked: Untracked = "background",
        recompute: Level = "nothing",
    ) -> None:
        super().__init__()
        self.image_size, self.sigma = image_size, sigma
        self.input_size = (image_size, image_size)
        self.latents, self.readout, self.untracked = latents, readout, untracked
        everything = Recompute(recompute == "everything")
        self.recompute = everything
        self.encoder = VideoEncoder(image_size, grid)
        self.objects = ObjectNetworks(
            image_size,
            grid,
            glimpse_size,
            what,
            size or AnchoredSize(),
            max_objects,
            evaluation_objects or max_objects,
            track,
            stop,
            deep_heads=image_size >= 128,
            recompute=Recompute(recompute != "nothing"),
            recompute_looks=everything,
        )
        self.background = Background(image_size, background, background_decoder)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Explains a video (scalor.md section 2)."""
        if video.shape[-2:] != (self.image_size, self.image_size):
            raise ValueError(f"the model was built for {self.image_size} px images, the video has {video.shape[-2:]}")
        before: State | None = context.state
        noise = context.noise if self.training or self.latents == "samples" else None
        features, memory = self.encoder(video, None if before is None else before.memory)
        steps, slots = self.objects(video, features, None if before is None else before.slots, noise, context.schedule)
        layers = render(self.objects, steps, context.schedule)
        with full_precision(video):
            rendered, background, terms = self._render(video, layers, before, noise)
            terms |= added(
                discovery_terms(steps, context.schedule["discovery_presence"]),
                propagation_terms(steps, self.objects.propagation.prior),
            )
        state = _detached(State(memory, slots, background))
        return self._scene(steps, layers, rendered, terms, state, context.detail)

    def _render(
        self, video: Tensor, layers: Layers, before: State | None, noise: Noise | None
    ) -> tuple[Rendered, tuple[Tensor, Tensor], Terms]:
        """Foreground, background, likelihood: no frame waits for another.

        Returns also what the background's prior of the next chunk starts from.
        """
        b, t = video.shape[:2]
        foreground = clamped(layers.alpha)
        objects = layers.colour / (layers.weight + GUARD)[:, :, None]
        q = self.recompute(self.background.posterior, video.flatten(0, 1), foreground.flatten(0, 1))
        latent = q.sample(None if noise is None else noise.at(0, t))
        prior, after = self.background.prior(latent.unflatten(0, (b, t)), None if before is None else before.background)
        q = type(q)(*(x.unflatten(0, (b, t)) for x in q))
        backdrop = self.recompute(self.background.draw, latent).unflatten(0, (b, t))
        image = objects + (1 - foreground)[:, :, None] * backdrop
        terms = {
            "nll": -log_likelihood(video, image, self.sigma).sum(1),
            "kl_background": kl_gaussian(q, prior).sum(1),
        }
        return Rendered(foreground, backdrop, image), after, terms

    @torch.no_grad()
    def _scene(
        self, steps: list[Step], layers: Layers, rendered: Rendered, terms: Terms, state: State, detail: bool
    ) -> Scene:
        """The P objects that are kept after each frame, and the background, last."""
        frames = [Frame(step) for step in steps]
        with full_precision(rendered.image):
            masks = torch.stack(
                [
                    frame_masks(
                        frame,
                        Layers(*(x[:, t] for x in layers)),
                        rendered.foreground[:, t],
                        self.readout,
                        self.untracked,
                    )
                    for t, frame in enumerate(frames)
                ],
                dim=1,
            )
            means = None
            if detail:
                means = torch.stack(
                    [
                        frame_means(frame, self.objects.glimpse_decoder(frame.what)[:, :, :3], rendered.backdrop[:, t])
                        for t, frame in enumerate(frames)
                    ],
                    dim=1,
                )
        kept = torch.stack([step.kept for step in steps], dim=1)
        ids = torch.stack([step.ids for step in steps], dim=1)
        what = torch.stack([frame.what for frame in frames], dim=1)
        return Scene(
            masks=masks,
            background=torch.arange(masks.shape[2], device=masks.device) == masks.shape[2] - 1,
            ids=torch.cat([ids, torch.full_like(ids[:, :, :1], BACKGROUND_ID)], dim=2),
            # A kept object is there, by the model's own rules; the relaxed z_pres of one can be below 1/2.
            presence=torch.cat([kept, torch.ones_like(kept[:, :, :1])], dim=2).to(masks.dtype),
            appearance=torch.cat([what, torch.zeros_like(what[:, :, :1])], dim=2),
            reconstruction=rendered.image.detach().clamp(0, 1),
            terms=terms,
            windows=shown_windows(frames) if detail else None,
            means=means,
            diagnostics=diagnostics(steps, frames, kept, rendered.foreground),
            state=state,
        )


def _detached(state: State) -> State:
    """The next chunk's gradients stop at its start."""
    slots = state.slots
    return State(
        [(h.detach(), c.detach()) for h, c in state.memory],
        slots._replace(objects=type(slots.objects)(*(x.detach() for x in slots.objects))),
        (state.background[0].detach(), state.background[1].detach()),
    )

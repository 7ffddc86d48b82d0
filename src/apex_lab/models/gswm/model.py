"""G-SWM: the model (Lin et al. 2020; gswm.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.models.gswm.background import Backdrop, Background, BackgroundState
from apex_lab.models.gswm.discovery import Discovering, Discovery, Draw, Posterior, discovering, needed_frames
from apex_lab.models.gswm.history import Environment, Fused, History, Memory
from apex_lab.models.gswm.image_encoder import ImageEncoder
from apex_lab.models.gswm.latents import DEPTH, WHERE, Attributes, Draws, Latents, attributes, draw
from apex_lab.models.gswm.objective import discovery_terms, propagation_terms
from apex_lab.models.gswm.propagation import Motion, Propagated, Propagation
from apex_lab.models.gswm.rendering import Renderer, negative_log_likelihood
from apex_lab.models.gswm.result import scene_of
from apex_lab.models.gswm.slots import FIRST_ID, keep
from apex_lab.scene import Context, Scene, SceneModel, Schedule

Count = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]


class Slots(NamedTuple):
    """The objects kept after a frame: z (B, M, Z), recurrent states, ids (B, M), and the next new identity (B,)."""

    z: Tensor
    memory: Memory
    ids: Tensor
    next_id: Tensor


class State(NamedTuple):
    """`Scene.state`: the background's LSTMs (None without a learned one) and the objects after the last frame."""

    background: BackgroundState | None
    slots: Slots


def detached(state: State) -> State:
    """The next chunk's gradients stop at its start, and the graph of this one can be freed."""
    background = None if state.background is None else BackgroundState(*(x.detach() for x in state.background))
    slots = state.slots
    memory = Memory(*(x.detach() for x in slots.memory))
    return State(background, slots._replace(z=slots.z.detach(), memory=memory))


class Frame(NamedTuple):
    """What the loop over time reads of one frame.

    image (B, 3, H, W): RGB in [0, 1]. scenery (B, ...): what objects see of the background, `History.scenery`.
    features (B, F, G, G): of the cells. draws: random numbers. discovers (B,): videos that may discover; None: all.
    """

    image: Tensor
    scenery: Tensor
    features: Tensor
    draws: Draws
    discovers: Tensor | None


class Step(NamedTuple):
    """One frame as the loop leaves it: the kept objects (B, M, Z), their ids and sources, and what the loss needs."""

    z: Tensor
    ids: Tensor
    source: Tensor
    posterior: Posterior
    propagated: Propagated | None


class Gswm(SceneModel):
    """Generative Structured World Model: objects with positions, looks and stochastic dynamics over a background.

    Args:
        image_size: H = W in pixels.
        image_encoder: frames -> features of discovery's cells; its grid is the model's.
        background: the background's VAE; null: the background is black.
        motion: how far attributes change from frame to frame.
        max_objects: M, objects kept per frame, at most G^2.
        what, dyna: lengths of z_what and z_dyna.
        hidden: of the objects' networks and recurrent states.
        glimpse_size: side of crops and decoded glimpses in pixels.
        glimpse_widths: channels of the encoders of crops; the decoder has them in reverse.
        environment: what of the background an object's state sees: a crop around it (`attention`), the whole image, or
            nothing.
        environment_margin: how much larger that crop is than the object's box, as a share of the image side.
        map_sigma: standard deviation of the kernel that shows tracked objects to discovery, in [-1, 1] coordinates.
        rejection_iou: discovered objects that overlap a tracked one by more are rejected; null rejects none.
        scale_std: standard deviation of the prior of a discovered object's raw size.
        discovery_dropout: probability in training that a frame after the first does not discover.
        discovery_draw: how these frames are drawn, `independent`, `balanced` or `batch`: see `discovery.discovering`.
        evaluation: latents in evaluation: sampled, as published, or their means.
        unused_parameters: have the published model's parameters that nothing reads too, to compare counts; they are
            zero and not trained.
    """

    term_names = (
        "nll",
        "kl_background",
        "kl_pres",
        "kl_depth",
        "kl_where",
        "kl_what",
        "kl_dyna",
        "kl_propagation",
        "presence_cost",
    )
    schedule_ranges: ClassVar = {
        "temperature": (0.01, 100.0),
        "presence_prior": (1e-15, 1.0),
        "scale_mean": (-10.0, 10.0),
        "sigma": (1e-3, 100.0),
        "background_only": (0.0, 1.0),
        "fixed_alpha": (0.0, 1.0),
    }
    optional_schedules = ("fixed_alpha",)

    def __init__(
        self,
        image_size: Count,
        image_encoder: ImageEncoder,
        background: Background | None,
        motion: Motion,
        max_objects: Count = 10,
        what: Count = 64,
        dyna: Count = 128,
        hidden: Count = 128,
        glimpse_size: Count = 16,
        glimpse_widths: Sequence[Count] = (16, 32, 64, 128),
        environment: Environment = "attention",
        environment_margin: Annotated[float, Field(ge=0)] = 0.25,
        map_sigma: Positive = 0.1,
        rejection_iou: Share | None = 0.8,
        scale_std: Positive = 0.1,
        discovery_dropout: Share = 0.5,
        discovery_draw: Draw = "independent",
        evaluation: Latents = "sample",
        unused_parameters: bool = False,
    ) -> None:
        super().__init__()
        self.cells = image_encoder.grid**2
        if max_objects > self.cells:
            raise ValueError(
                f"model.max_objects={max_objects} must be at most {self.cells}, the cells of discovery: raise "
                f"model.image_encoder.grid={image_encoder.grid}"
            )
        self.image_size, self.max_objects, self.what, self.scale_std = image_size, max_objects, what, scale_std
        self.input_size = (image_size, image_size)
        self.discovery_dropout, self.discovery_draw = discovery_dropout, discovery_draw
        self.evaluation = evaluation
        self.each = DEPTH + WHERE + what + dyna
        self.image_encoder, self.background = image_encoder, background
        self.propagation = Propagation(what, dyna, hidden, glimpse_size, glimpse_widths, motion)
        self.discovery = Discovery(
            image_encoder.outputs, image_encoder.grid, what, dyna, hidden, map_sigma, rejection_iou
        )
        side = image_size if environment == "whole" else glimpse_size
        self.history = History(1 + self.each, hidden, environment, environment_margin, side, glimpse_widths)
        self.renderer = Renderer(what, glimpse_size, glimpse_widths[::-1], image_size)
        if unused_parameters:
            starts, head = torch.zeros(2, hidden), torch.zeros(2 * dyna, hidden + 1)  # discovery's old z_dyna outputs
            self.unused = nn.ParameterList(nn.Parameter(x, requires_grad=False) for x in (starts, head))
        normalises = any(isinstance(module, nn.BatchNorm2d) for module in self.modules())
        self.batch_statistics = normalises or discovery_draw == "batch"  # a draw that shares of a batch would not share

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Infers a video.

        Args:
            video: RGB in [0, 1].
            context: its schedule holds `temperature` of the relaxed Bernoulli; `presence_prior`, the prior probability
                of z_pres; `scale_mean`, mean of the prior of a discovered object's raw size; `sigma`, standard
                deviation of the likelihood; `background_only`: while it is 1, the background explains frames alone
                and objects cost nothing; `fixed_alpha` (may be missing): above 0, the mask that every object has all
                over its window.
        """
        if video.shape[-2:] != (self.image_size, self.image_size):
            raise ValueError(
                f"the model was built for images of model.image_size={self.image_size} pixels, the video has "
                f"{tuple(video.shape[-2:])}"
            )
        state: State | None = context.state
        latents: Latents = "sample" if self.training else self.evaluation
        size = 0 if self.background is None else self.background.latent
        draws = draw(context.noise, video, size, self.cells, self.max_objects, self.each, latents)
        backdrop = self._backdrop(video, draws, state)
        which = Discovering(None, None)
        if self.training:
            dropout, how = self.discovery_dropout, self.discovery_draw
            which = discovering(draws.discover, dropout, how, first=state is None)
        features = self._features(video, backdrop.images, which)
        frames = frames_of(video, self.history.scenery(backdrop.images), features, draws, which)
        steps, slots = self._roll_out(frames, None if state is None else state.slots, context.schedule)
        return self._explain(video, backdrop, which, steps, slots, context)

    def _backdrop(self, video: Tensor, draws: Draws, state: State | None) -> Backdrop | BlackBackdrop:
        if self.background is None:
            return BlackBackdrop(torch.zeros_like(video), video.new_zeros(video.shape[:2]), None)
        return self.background(video, draws.context, None if state is None else state.background)

    def _features(self, video: Tensor, backdrops: Tensor, which: Discovering) -> Float[Tensor, "B T F G G"]:
        """Features of the frames that need them, zeros for the others. Gradients reach the background."""
        images = torch.cat([video, video - backdrops], dim=2)
        frames = which.frames if self.image_encoder.kind == "clip" else needed_frames(which)
        if frames is None:
            return self.image_encoder(images)
        index = frames[..., None, None, None]
        features = self.image_encoder(images.gather(1, index.expand(-1, -1, *images.shape[2:])))
        whole = features.new_zeros(*video.shape[:2], *features.shape[2:])
        return whole.scatter(1, index.expand(-1, -1, *features.shape[2:]), features)

    def _roll_out(self, frames: Sequence[Frame], slots: Slots | None, schedule: Schedule) -> tuple[list[Step], Slots]:
        """The part that depends on the frame before, frame by frame."""
        fused = self.history.interaction.fused()
        steps = []
        for frame in frames:
            step, slots = self._advance(frame, slots, fused, schedule["temperature"])
            steps.append(step)
        assert slots is not None
        return steps, slots

    def _advance(self, frame: Frame, before: Slots | None, fused: Fused, temperature: Tensor) -> tuple[Step, Slots]:
        """One frame: propagation, discovery, selection, and the states of the objects kept."""
        b, draws = len(frame.image), frame.draws
        tracked: Attributes | None = None
        propagated: Propagated | None = None
        if before is not None:
            tracked, propagated = self.propagation(
                attributes(before.z, self.what),
                before.memory.hidden,
                frame.image,
                draws.slots,
                draws.slot_presence,
                temperature,
            )
        found, posterior = self.discovery(frame.features, tracked, draws.cells, draws.cell_presence, temperature)
        z, memory = found.joined(), self.history.begin(b, self.cells)
        ids, next_id = None, frame.image.new_full((b,), FIRST_ID, dtype=torch.long)
        pres = None
        if before is not None and tracked is not None:
            z = torch.cat([z, tracked.joined()], dim=1)
            memory = Memory(*(torch.cat(states, dim=2) for states in zip(memory, before.memory, strict=True)))
            ids, next_id, pres = before.ids, before.next_id, tracked.pres[..., 0]
        kept = keep(found.pres[..., 0], pres, ids, next_id, self.max_objects, frame.discovers)
        z, memory = self.history(z, memory, kept.source, self.cells, frame.scenery, fused)
        step = Step(z, kept.ids, kept.source, posterior, propagated)
        return step, Slots(z, memory, kept.ids, next_id + self.cells)

    def _explain(
        self,
        video: Tensor,
        backdrop: Backdrop | BlackBackdrop,
        which: Discovering,
        steps: Sequence[Step],
        slots: Slots,
        context: Context,
    ) -> Scene:
        """Rendering, likelihood, KL and the result: no frame waits for another."""
        b, t = video.shape[:2]
        schedule = context.schedule
        z, ids, source = (torch.stack(x, dim=1) for x in zip(*(step[:3] for step in steps), strict=True))
        objects = attributes(z, self.what)
        drawn = self.renderer(
            Attributes(*(part.flatten(0, 1) for part in objects)),
            backdrop.images.flatten(0, 1),
            context.detail,
            schedule.get("fixed_alpha"),
        )
        found = Posterior(*(torch.stack(parts, dim=1) for parts in zip(*(s.posterior for s in steps), strict=True)))
        tracked = [step.propagated for step in steps if step.propagated is not None]
        propagated = Propagated(*(torch.stack(x, dim=1) for x in zip(*tracked, strict=True))) if tracked else None
        alone = schedule["background_only"] >= 0.5
        reconstruction = drawn.reconstruction.unflatten(0, (b, t))
        explained = torch.where(alone, backdrop.images, reconstruction)
        of_objects = discovery_terms(found, which.mask, self.what, schedule, self.scale_std)
        of_objects |= propagation_terms(propagated, self.propagation, schedule, video)
        terms = {
            "nll": negative_log_likelihood(video, explained, schedule["sigma"]),
            "kl_background": backdrop.kl.sum(1),
            **{name: torch.where(alone, 0.0, value) for name, value in of_objects.items()},
        }
        return scene_of(
            objects,
            ids,
            source >= self.cells,
            drawn,
            backdrop.images,
            terms,
            detached(State(backdrop.state, slots)),
            context.detail,
        )


class BlackBackdrop(NamedTuple):
    """A `Backdrop` without a background to learn."""

    images: Tensor
    kl: Tensor
    state: None


def frames_of(video: Tensor, scenery: Tensor, features: Tensor, draws: Draws, which: Discovering) -> list[Frame]:
    """Video -> frames: takes dimension 1 of everything apart, at once, as autograd likes it."""
    discovers = [None] * video.shape[1] if which.mask is None else list(which.mask.unbind(1))
    of_frames = [Draws(*values) for values in zip(*(x.unbind(1) for x in draws), strict=True)]
    tensors = zip(video.unbind(1), scenery.unbind(1), features.unbind(1), of_frames, discovers, strict=True)
    return [Frame(*values) for values in tensors]

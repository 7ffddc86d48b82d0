"""APEX: the model (apex_paper, section "APEX"; apex.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.profiler import record_function

from apex_lab.models.apex.background import Background
from apex_lab.models.apex.encoder import ApexEncoder
from apex_lab.models.apex.foresight import NoiseOfFrames, Plan, planned
from apex_lab.models.apex.glimpses import Glimpses
from apex_lab.models.apex.likelihood import Likelihood, MixtureLikelihood
from apex_lab.models.apex.loop import claims_of, roll_out
from apex_lab.models.apex.masks import MaskNormalisation, Masks, blended
from apex_lab.models.apex.merging import merged
from apex_lab.models.apex.objective import Direction, DiscoveryPrior, kl_terms, loose_windows, mask_entropy
from apex_lab.models.apex.objects import Appearance, Beliefs, Discovery, Propagation, Proposals, at_frames
from apex_lab.models.apex.parts import Part, in_order, parts_of
from apex_lab.models.apex.pixels import PixelEvidence
from apex_lab.models.apex.result import Drawn, Picture, scene_of, video_of
from apex_lab.models.apex.rollout import Memory, State, Step, frames_of
from apex_lab.models.apex.windows import Windows, size_logit, window_of
from apex_lab.nn.blocks import SubpixelDecoder
from apex_lab.nn.distributions import kl_gaussian
from apex_lab.nn.shared import gathered_gradients
from apex_lab.nn.slots import may_look, none_of
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.scene import Context, Noise, Scene, SceneModel, Schedule, Statistics

Count = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


class Apex(SceneModel):
    """Amortised Parallel infErence with miXture models.

    Args:
        image_size: H = W in pixels, a multiple of 32.
        encoder: video -> feature maps.
        glimpses: where glimpses come from, and their CNNs.
        masks: mask normalisation.
        likelihood: of the image.
        background: the background component.
        discovery_prior: of discovered objects' windows.
        what: length of z_what.
        hidden: of the recurrent networks.
        grid: G; discovery has G^2 cells.
        max_objects: P, slots that carry objects from frame to frame.
        render_top: N, how many discovery cells per frame are rendered, by presence probability; null renders all.
        glimpse_size: side of the decoded glimpses in pixels.
        decoder_width: channels of the glimpse decoders.
        kl: direction of the KL of z_what and z_where; the paper minimises the inclusive one, KL(p || q).
        keep_threshold: objects with a z_pres below it are not carried on.
        reach: of a discovered window's centre, in cells.
        size_step, centre_step: largest change per frame of a size logit and of a centre.
        start_size: window size at the start of training, as a share of the image side.
        start_presence: p_proposal at the start of training.
        start_mask: output of the mask decoder at the start of training (before the normalisation's squashing). Above
            zero, windows start solid: one that reaches over background costs likelihood, so windows fit what they hold
            before masks have shapes, instead of growing over everything.
        start_std: standard deviation of q(z_what) at the start of training. A narrow one lets codes reach the decoders
            before noise drowns them; under the inclusive KL it costs 1 / (2 std^2) nats per dimension and object.
        merges: how often per frame two proposals of discovery may become one (see merging.py); the paper's is 0.
        piece_price: nats that two such proposals cost beyond their own per pixel of the rim along which they meet.
        hollow_price: nats that their union costs per pixel of background between them (see `merging.gap`).
        pixel_features: how many features of each pixel shift the mask logits (see pixels.py); the paper's is 0.
        whole_colours: whether the mixture of channels becomes one of whole colours as `refinement` goes to 1.
    """

    term_names = ("nll", "kl_what", "kl_where", "kl_pres", "kl_background", "mask_entropy", "loose_windows")
    optional_terms = ("loose_windows",)
    schedule_ranges: ClassVar = {
        "temperature": (0.01, 100.0),
        "discovery_presence": (0.0, 1.0),
        "carry": (0.0, 1.0),
        "discover": (0.0, 1.0),
        "sigma_fg_scale": (0.01, 100.0),
        "sigma_bg_scale": (0.01, 100.0),
        "shadow": (0.0, 1.0),
        "refinement": (0.0, 1.0),
    }
    optional_schedules = ("shadow", "refinement")
    changeable = ("max_objects", "render_top", "keep_threshold", "merges", "piece_price", "hollow_price")

    def __init__(
        self,
        image_size: Count,
        encoder: ApexEncoder,
        glimpses: Glimpses,
        masks: MaskNormalisation,
        likelihood: Likelihood,
        background: Background,
        discovery_prior: DiscoveryPrior,
        what: Count = 64,
        hidden: Count = 128,
        grid: Count = 8,
        max_objects: Count = 10,
        render_top: Count | None = 10,
        glimpse_size: Count = 32,
        decoder_width: Count = 16,
        kl: Direction = "inclusive",
        keep_threshold: Share = 0.5,
        reach: Positive = 1.5,
        size_step: Positive = 0.3,
        centre_step: Positive = 0.2,
        start_size: Share = 0.25,
        start_presence: Share = 0.1,
        start_mask: float = 0.0,
        start_std: Positive = 0.5,
        merges: Annotated[int, Field(ge=0, le=64)] = 0,
        piece_price: Annotated[float, Field(ge=0)] = 0.0,
        hollow_price: Annotated[float, Field(ge=0)] = 0.0,
        pixel_features: Annotated[int, Field(ge=0)] = 0,
        whole_colours: bool = False,
    ) -> None:
        super().__init__()
        if image_size % 32 or (image_size // encoder.stride) % grid:
            raise ValueError(
                f"model.image_size={image_size} must be a multiple of 32, its quarter one of model.grid={grid}"
            )
        if background.image_size != image_size:
            raise ValueError(
                f"model.background.image_size={background.image_size} must be that of the model, {image_size}"
            )
        if whole_colours and isinstance(likelihood, MixtureLikelihood) and likelihood.mixture_over == "pixel":
            raise ValueError(
                "model.likelihood.mixture_over=pixel mixes whole colours from the start and model.whole_colours=true "
                "mixes channels at first: set model.whole_colours=false or model.likelihood.mixture_over=channel"
            )
        self.image_size, self.hidden, self.max_objects = image_size, hidden, max_objects
        self.input_size = (image_size, image_size)
        self.render_top = min(render_top or grid**2, grid**2)
        self.merges, self.piece_price, self.hollow_price = merges, piece_price, hollow_price
        self.whole_colours = whole_colours
        self.has_posterior = isinstance(likelihood, MixtureLikelihood)
        self.direction, self.keep_threshold = kl, keep_threshold
        self.masks, self.likelihood, self.discovery_prior = masks, likelihood, discovery_prior
        self.encoder, self.glimpses, self.background = encoder, glimpses, background
        windows = Windows(grid, reach, size_step, centre_step)
        self.appearance = Appearance(hidden, what, hidden, start_std, glimpses.shortcut)
        self.propagation = Propagation(hidden, what, hidden, windows)
        self.discovery = Discovery(
            encoder.features, grid, what, hidden, windows, size_logit(start_size), start_presence
        )
        self.mask_decoder = SubpixelDecoder(what, glimpse_size, decoder_width, 1)
        self.colour_decoder = SubpixelDecoder(what, glimpse_size, decoder_width, 3)
        # Last, so that all other weights start at the same values whatever the glimpses are cut from.
        self.glimpses.build(encoder.features, hidden)
        self.mask_decoder.start_at(start_mask)
        self.pixels = PixelEvidence(what, pixel_features) if pixel_features else None

    def initialise(self, statistics: Statistics) -> None:
        """Starts the background at the training set's median, if it has a bias image."""
        if self.background.bias_image is not None:
            self.background.initialise(statistics.median)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """Explains a video.

        Args:
            video: RGB in [0, 1].
            context: its schedule holds `temperature` of the relaxed Bernoulli; `discovery_presence` p0; `carry`, the
                probability in [0, 1] with which a video's objects are carried into the next frame in training (see
                `loop.carries_on`); `discover`, the probability in [0, 1] with which a carried video may discover too
                (see `loop.may_discover`); `sigma_fg_scale` and `sigma_bg_scale`, what the likelihood's sigmas are
                multiplied by. A wide sigma_bg: the background first learns what it can, such as cast shadows, before
                objects are asked to explain the rest. A wide sigma_fg: while objects cannot be drawn well yet, two
                components of half an object gain less likelihood over one of the whole than the second one costs.
                `shadow` (may be missing: 1), how much of the background's shadow depth counts. `refinement` (may be
                missing: 1), how much counts of pixels in masks and of whole colours in the mixture.
        """
        if video.shape[-2:] != (self.image_size, self.image_size):
            raise ValueError(f"the model was built for {self.image_size} px images, the video has {video.shape[-2:]}")
        before: State | None = context.state
        noise = context.noise if self.training else None
        with record_function("encoder"):
            features, encoder = self.encoder(video, None if before is None else before.encoder)
        look_at, follow_in = self.glimpses.sources(video, features, None if before is None else before.frame)
        memory = (
            Memory.empty(len(video), self.max_objects, self.appearance.what, self.hidden, features)
            if before is None
            else before.memory
        )
        plan = self._plan(memory, features, context.schedule, noise)
        with record_function("discovery"):
            images = video.flatten(0, 1)
            evidence = self._evidence(images, context.schedule)
            found = self._proposed(features, look_at, plan, images, evidence, context.schedule)
            alphas = self.alpha(found.what)
        with record_function("loop over time"):
            shape = (video.shape[0], video.shape[1])
            claims = claims_of(self, alphas, found.place, plan, shape)
            proposals = found.over_time(shape, plan.opened)
            frames = frames_of(look_at, follow_in, proposals, at_frames(alphas, shape, plan.opened))
            shared = (self.propagation, self.appearance, self.glimpses, self.mask_decoder)
            with gathered_gradients(*shared, like=features):
                steps, memory = roll_out(self, frames, claims, memory, context.schedule, plan.noise)
        with record_function("rendering"):
            return self._explain(
                video, proposals, steps, context, noise, lambda z: State(encoder, video[:, -1], memory, z), evidence
            )

    def posterior(
        self, scene: Scene, video: Float[Tensor, "B T 3 H W"], context: Context
    ) -> Float[Tensor, "B T K H W"]:
        """Responsibilities of the objects carried on and the background under Eq. 1; see `SceneModel.posterior`."""
        if not isinstance(self.likelihood, MixtureLikelihood):
            return super().posterior(scene, video, context)
        if scene.means is None:
            raise ValueError("the scene has no means: give Context(detail=True) for scenes whose posterior is wanted")
        found = self.likelihood.responsibilities(
            video.flatten(0, 1),
            scene.masks.flatten(0, 1).float(),
            scene.means.flatten(0, 1).float(),
            scene.background,
            context.schedule["sigma_fg_scale"],
            context.schedule["sigma_bg_scale"],
            None
            if self.background.shadow == 1
            else self._shadowed(scene, video, context.schedule).flatten(0, 1).float(),
            self._whole(context.schedule),
        )
        return found.unflatten(0, video.shape[:2])

    def _shadowed(
        self, scene: Scene, video: Float[Tensor, "B T 3 H W"], schedule: Schedule
    ) -> Float[Tensor, "B T K 3 H W"]:
        """The components' images with cast shadows on that of the background."""
        assert scene.means is not None
        cast = self.background.cast(scene.means, video[:, :, None].expand_as(scene.means), schedule.get("shadow"))
        return torch.where(scene.background[:, None, None, None], cast, scene.means)

    def alpha(self, what: Float[Tensor, "*batch Z"]) -> Float[Tensor, "*batch g g"]:
        """Mask logits, as `MaskNormalisation` takes them."""
        raw = self.mask_decoder(what.reshape(-1, what.shape[-1]))
        return self.masks.logits(raw).reshape(*what.shape[:-1], *raw.shape[-2:])

    def _evidence(self, images: Float[Tensor, "F 3 H W"], schedule: Schedule) -> Float[Tensor, "F C H W"] | None:
        """Features of pixels that masks may see; None where there are none, or where they would not count."""
        if self.pixels is None or none_of(schedule.get("refinement", images.new_ones(()))):
            return None
        bias = self.background.bias_image
        if bias is None:
            return self.pixels(images, images)
        empty = torch.sigmoid(bias.detach()).expand_as(images)
        return self.pixels(images, self.background.cast(empty, images, schedule.get("shadow")))

    def sharpened(
        self,
        alpha: Float[Tensor, "N n g g"],
        what: Float[Tensor, "N n Z"],
        place: Float[Tensor, "N n 4"],
        evidence: Float[Tensor, "N C H W"] | None,
        schedule: Schedule,
    ) -> Float[Tensor, "N n g g"]:
        """Mask logits of components of N frames with what their pixels say."""
        if self.pixels is None:
            return alpha
        if evidence is None:
            return alpha + self.pixels.nothing()
        shift = self.pixels.shifts(evidence, what, window_of(place), alpha.shape[-1])
        return self.masks.logits(self.masks.raw(alpha) + shift * schedule.get("refinement", 1.0))

    def colours(self, what: Float[Tensor, "*batch Z"]) -> Float[Tensor, "*batch 3 g g"]:
        """RGB in [0, 1]."""
        return torch.sigmoid(self.colour_decoder(what.reshape(-1, what.shape[-1]))).unflatten(0, what.shape[:-1])

    def paster(self, place: Float[Tensor, "*batch 4"], glimpse: int) -> Paster:
        """Pastes glimpses into images through the windows at these places."""
        return Paster(window_of(place), glimpse, self.image_size)

    def log_likelihood(
        self,
        images: Float[Tensor, "N 3 H W"],
        masks: Masks,
        means: Float[Tensor, "N n 3 H W"],
        backdrop: Float[Tensor, "N 3 H W"],
        schedule: Schedule,
    ) -> Float[Tensor, " N"]:
        """log p(x | masks, means) of N frames in nats."""
        return self.likelihood(
            images,
            masks.log_objects,
            means,
            masks.log_background,
            self.background.seen(backdrop, images, schedule.get("shadow")),
            schedule["sigma_fg_scale"],
            schedule["sigma_bg_scale"],
            self._whole(schedule),
        )

    def _whole(self, schedule: Schedule) -> Float[Tensor, ""] | None:
        """How much the mixture is one of whole colours; None: as the likelihood was built."""
        if not self.whole_colours:
            return None
        refinement = schedule.get("refinement")
        return torch.ones_like(schedule["temperature"]) if refinement is None else refinement

    def _plan(self, memory: Memory, features: Tensor, schedule: Schedule, noise: Noise | None) -> Plan:
        """What the pass works on: on a CPU, in training, as little as it can."""
        if noise is None or not may_look(features):
            return Plan(noise)
        sizes = (self.discovery.grid**2, self.max_objects, self.appearance.what)
        return planned(noise, memory.carried_on, features.shape[1], sizes, schedule, features)

    def _proposed(
        self, features: Tensor, look_at: Tensor, plan: Plan, images: Tensor, evidence: Tensor | None, schedule: Schedule
    ) -> Proposals:
        """Discovery's proposals in all frames where it may find something, (F, D, ...)."""
        maps, noise, frames = [x.flatten(0, 1) for x in (features, look_at)], plan.noise, plan.opened
        if frames is not None:
            assert noise is not None
            images = images.index_select(0, frames)
            evidence = None if evidence is None else evidence.index_select(0, frames)
            maps, noise = [x.index_select(0, frames) for x in maps], NoiseOfFrames(noise, frames, len(maps[0]))
        found = self.discovery(*maps, self.glimpses, self.appearance, noise)
        if self.merges:
            found = merged(self, found, images, maps[1], schedule, evidence, rounds=self.merges)
        return found

    def _explain(
        self,
        video: Tensor,
        proposals: Proposals,
        steps: Step,
        context: Context,
        noise: Noise | None,
        state_with: Callable[[Tensor], State],
        evidence: Tensor | None,
    ) -> Scene:
        """Rendering, likelihood, KL and the result; no frame waits for another, so a GPU does all at once."""
        b, t = video.shape[:2]
        images, source = video.flatten(0, 1), steps.source.flatten(0, 1)
        everything = [x.flatten(0, 1) for x in (steps.alpha, steps.presence, steps.valid, steps.place, steps.what)]
        parts = parts_of(everything[2], 3 * self.image_size**2, video)
        seen = [Drawn(*map(part.of_components, everything)) for part in parts]
        pasters = [self.paster(part.place, part.alpha.shape[-1]) for part in seen]
        masks = [
            self._masks(drawn, paster, None if evidence is None else part.of_frames(evidence), context.schedule)
            for part, drawn, paster in zip(parts, seen, pasters, strict=True)
        ]
        z_background, kl_background = self._background(
            in_order(parts, [m.background for m in masks]), images, (b, t), context, noise
        )
        backdrop = self.background.decode(z_background)
        pictures = [
            self._picture(part, images, source, drawn, paster, found, backdrop, context)
            for part, drawn, paster, found in zip(parts, seen, pasters, masks, strict=True)
        ]
        picture = video_of(parts, pictures, b)
        assert isinstance(steps.propagated, Beliefs)
        slots = self.max_objects
        terms = {
            # Eq. 19, and below the three factors of Eq. 4 as KL terms of Eq. 20; with the mask entropy, Eq. 22
            "nll": -picture.log_likelihood.sum(1),
            **kl_terms(
                steps.propagated,
                steps.alive,
                steps.presence[..., :slots],
                proposals,
                steps.discovery_prob,
                steps.discovery_prior,
                steps.discovery_pres,
                self.discovery_prior,
                self.direction,
            ),
            "kl_background": kl_background.sum(1),
            "mask_entropy": picture.mask_entropy.sum(1),
            "loose_windows": picture.loose_windows.sum(1),
        }
        terms = {name: term for name, term in terms.items() if name not in context.unused}
        last = z_background.unflatten(0, (b, t))[:, -1]
        return scene_of(steps, picture, terms, context.detail, state_with(last))

    def _masks(self, drawn: Drawn, paster: Paster, evidence: Tensor | None, schedule: Schedule) -> Masks:
        """Masks of a part's N frames."""
        alpha = self.sharpened(drawn.alpha, drawn.what, drawn.place, evidence, schedule)
        return self.masks.compose(alpha, drawn.presence, drawn.valid, paster)

    def _background(
        self,
        mask: Float[Tensor, "F H W"],
        images: Float[Tensor, "F 3 H W"],
        shape: tuple[int, int],
        context: Context,
        noise: Noise | None,
    ) -> tuple[Float[Tensor, "F Z"], Float[Tensor, "B T"]]:
        """The background's code of all frames, shape = (B, T), and its KL in nats."""
        posterior = self.background.posterior(mask, images)
        code = posterior.sample(noise)
        before = None if context.state is None else context.state.z_background
        prior = self.background.prior(code.unflatten(0, shape), before)
        return code, kl_gaussian(type(posterior)(*(x.unflatten(0, shape) for x in posterior)), prior)

    def _picture(
        self,
        part: Part,
        images: Tensor,
        source: Tensor,
        seen: Drawn,
        paster: Paster,
        masks: Masks,
        backdrops: Tensor,
        context: Context,
    ) -> Picture:
        """Appearance, likelihood and mask entropy of a part's N frames, whose masks are known."""
        image, backdrop = part.of_frames(images), part.of_frames(backdrops)
        means = paster.each(self.colours(seen.what))  # (N, n, 3, H, W)
        with record_function("likelihood"):
            log_likelihood = self.log_likelihood(image, masks, means, backdrop, context.schedule)
        return Picture(
            part.at(masks.objects, source),
            masks.foreground,
            blended(
                masks.objects,
                means,
                masks.background,
                self.background.cast(backdrop, image, context.schedule.get("shadow")),
            ),
            log_likelihood,
            mask_entropy(masks),
            torch.zeros_like(log_likelihood)
            if "loose_windows" in context.unused
            else loose_windows(masks.objects, seen.place, seen.presence * seen.valid),
            backdrop,
            part.at(means, source) if context.detail else None,
        )

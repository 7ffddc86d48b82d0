"""APEX as one would write it down first: what the benchmark compares `models.apex` with.

The same parts, weights, equations and loss terms, and as wide. What differs is how they are computed:

- everything happens frame by frame inside the loop over time: encoder, discovery, merging, rendering, likelihood, KL,
  result;
- every crop and paste is an `affine_grid` and a `grid_sample` with a picture of its own for every component;
- the mixture likelihood is a `logsumexp`, and it and p_context are differentiated by autograd;
- masks that see pixels, and pieces that become one, are calculated anew (apex_merging.py);
- `render_top=None` renders all cells of discovery, as the published equations do; a number renders as many as APEX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.config import components
from apex_lab.inference.predictor import joined
from apex_lab.models.apex.likelihood import MixtureLikelihood, log_normal
from apex_lab.models.apex.loop import carries_on, may_discover, rendered
from apex_lab.models.apex.masks import ApexNormalisation, Masks
from apex_lab.models.apex.model import Apex
from apex_lab.models.apex.objective import kl_terms
from apex_lab.models.apex.objects import (
    Beliefs,
    Objects,
    Proposals,
    context_probability,
    sample_presence,
    scope_in_windows,
)
from apex_lab.models.apex.parts import Part
from apex_lab.models.apex.result import Drawn, scene_of, video_of
from apex_lab.models.apex.rollout import Memory, Step, frames_of, stack_steps
from apex_lab.models.apex.slots import Carried, carry, gather_slots
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.distributions import Gaussian, kl_gaussian
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.scene import Context, Noise, Scene, Schedule
from tests.reference.apex_merging import merged, pixel_features, sharpened
from tests.reference.grid import GridPaster, grid_crop


class PlainMixture(MixtureLikelihood):
    """The mixture likelihood by `logsumexp` over all components, its gradient left to autograd."""

    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N S 3 H W"],
        scale_fg: Float[Tensor, ""] | None = None,
        scale_bg: Float[Tensor, ""] | None = None,
        whole: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, " N"]:
        if whole is not None:
            args = (image, log_objects, objects, log_background, background, scale_fg, scale_bg)
            channel, pixel = (PlainMixture(self.sigma_fg, self.sigma_bg, over) for over in ("channel", "pixel"))
            return (1 - whole) * channel(*args) + whole * pixel(*args)
        sigma_fg, sigma_bg = self._sigmas(image, scale_fg, scale_bg)
        by_object = log_normal(image[:, None], objects, sigma_fg)
        by_background = log_normal(image[:, None], background, sigma_bg)
        if self.mixture_over == "pixel":
            by_object, by_background = by_object.sum(2, keepdim=True), by_background.sum(2, keepdim=True)
        each = (log_background - math.log(background.shape[1]))[:, None, None]
        joint = torch.cat([by_object + log_objects[:, :, None], by_background + each], dim=1)
        return torch.logsumexp(joint, dim=1).flatten(1).sum(1)


class PlainNormalisation(ApexNormalisation):
    """APEX's mask normalisation with the gradient of claims left to autograd."""

    def claim(self, alpha: Float[Tensor, "... K g g"], paster: Paster) -> Float[Tensor, "... K H W"]:
        """As `ApexNormalisation.claim`."""
        rows, columns = paster.inside()
        warped = paster.each(alpha[..., None, :, :]).squeeze(-3)
        return torch.tanh(F.softplus(warped)) * rows[..., :, None] * columns[..., None, :]


class _Memory:
    """What a frame hands to the next one."""

    def __init__(self, model: Apex, frame: Tensor) -> None:
        b, side = len(frame), frame.shape[-1] // model.encoder.stride
        loop = Memory.empty(b, model.max_objects, model.appearance.what, model.hidden, frame)
        self.objects, self.valid, self.ids, self.next_id, self.carried_on = loop
        self.hidden = self.cell = frame.new_zeros(b, model.encoder.features, side, side)
        self.features: Tensor | None = None
        self.z_background: Tensor | None = None


class Straightforward(Apex):
    """Built with the arguments of `Apex`; takes its weights by `load_state_dict`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.glimpses.crop = grid_crop
        if isinstance(self.masks, ApexNormalisation):
            self.masks = PlainNormalisation(self.masks.c, self.masks.outside)
        if isinstance(self.likelihood, MixtureLikelihood):
            plain = self.likelihood
            self.likelihood = PlainMixture(plain.sigma_fg, plain.sigma_bg, plain.mixture_over)

    def paster(self, place: Float[Tensor, "*batch 4"], glimpse: int) -> GridPaster:
        return GridPaster(window_of(place), glimpse, self.image_size)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """As `Apex.forward` of a whole video, frame by frame."""
        memory = _Memory(self, video[:, 0])
        return joined([self._frame(video, i, memory, context) for i in range(video.shape[1])])

    def _frame(self, video: Tensor, i: int, memory: _Memory, context: Context) -> Scene:
        """Explains one frame and updates the memory."""
        noise = context.noise if self.training else None
        look_at, follow_in, features = self._sources(video, i, memory)
        found = self.discovery(features[:, 0], look_at, self.glimpses, self.appearance, noise)
        pixels = pixel_features(self, video[:, i], context.schedule)
        for _ in range(self.merges):
            found = merged(self, found, video[:, i], look_at, pixels, context.schedule)
        proposals = found.over_time((len(video), 1), None)
        step = self._infer(look_at, follow_in, proposals, memory, context.schedule, noise)
        return self._render(video[:, i : i + 1], pixels, proposals, step, memory, context, noise)

    def _sources(self, video: Tensor, i: int, memory: _Memory) -> tuple[Tensor, Tensor, Tensor]:
        """What is looked at in this frame and what is followed, (B, C, h, w), and its features (B, 1, F, h, w)."""
        lstm = self.encoder.over_time
        frame = self.encoder.of_images(video[:, i])
        memory.hidden, memory.cell = lstm.step(lstm.from_input(frame), memory.hidden, memory.cell)
        features = (frame + memory.hidden if self.encoder.colour is not None else memory.hidden)[:, None]
        before = features if memory.features is None else memory.features
        memory.features = features
        pair = torch.cat([before, features], dim=1)
        look_at, follow_in = self.glimpses.sources(video[:, [max(i - 1, 0), i]], pair)
        return look_at[:, -1], follow_in[:, -1], features

    def _infer(
        self,
        look_at: Tensor,
        follow_in: Tensor,
        proposals: Proposals,
        memory: _Memory,
        schedule: Schedule,
        noise: Noise | None,
    ) -> Step:
        """Propagation, presence of discoveries, filtering: the body of the loop in `loop.roll_out`."""
        temperature = schedule["temperature"]
        before, posterior = self.propagation(
            memory.objects,
            self.glimpses,
            self.appearance,
            look_at,
            follow_in,
            memory.valid,
            temperature,
            noise,
        )
        alpha, alphas = self.alpha(before.what), self.alpha(proposals.what[:, 0])
        scope = 1 - self.masks.foreground(alpha, before.presence, self.paster(before.place, alpha.shape[-1]))
        paster = self.paster(proposals.place[:, 0], alphas.shape[-1])
        claims = self.masks.claim(alphas, paster)
        [cells] = frames_of(look_at[:, None], follow_in[:, None], proposals, alphas[:, None])

        open_ = may_discover(memory.carried_on, schedule, noise).to(scope.dtype)
        prob = cells.prob * context_probability(scope, claims) * open_
        prior = schedule["discovery_presence"] * scope_in_windows(scope, *paster.inside()) * open_
        pres = sample_presence(prob, temperature, noise) * open_
        top = prob.detach().topk(self.render_top, dim=1).indices
        found = rendered(cells, pres, top, self.hidden)
        candidates = Objects(*(torch.cat(pair, dim=1) for pair in zip(before, found, strict=True)))
        exists = torch.cat([memory.valid, torch.ones_like(top, dtype=torch.bool)], dim=1)
        kept = carry(candidates.presence, exists, memory.ids, memory.next_id, self.keep_threshold)
        alive = memory.valid
        self._remember(memory, candidates, kept, schedule, noise)
        return Step(
            candidates.what,
            candidates.place,
            torch.cat([alpha, gather_slots(alphas, top)], dim=1),
            candidates.presence,
            exists & (candidates.presence > 0),
            alive,
            self.propagation.beliefs(posterior),
            prob,
            prior,
            pres,
            kept.source,
            kept.valid,
            kept.ids,
        )

    def _remember(
        self, memory: _Memory, candidates: Objects, kept: Carried, schedule: Schedule, noise: Noise | None
    ) -> None:
        memory.objects = Objects(*(gather_slots(field, kept.source) for field in candidates))
        memory.ids, memory.next_id = kept.ids, kept.next_id
        memory.carried_on = carries_on(memory.carried_on, schedule, noise)
        memory.valid = kept.valid & memory.carried_on

    def _render(
        self,
        frame: Float[Tensor, "B 1 3 H W"],
        pixels: Float[Tensor, "B E H W"] | None,
        proposals: Proposals,
        step: Step,
        memory: _Memory,
        context: Context,
        noise: Noise | None,
    ) -> Scene:
        """Rendering, likelihood, KL and the result of one frame."""
        steps = stack_steps([step])
        alpha, presence, valid, place, what = (
            x[:, 0] for x in (steps.alpha, steps.presence, steps.valid, steps.place, steps.what)
        )
        paster = self.paster(place, alpha.shape[-1])
        sharp = sharpened(self, alpha, what, place, pixels, context.schedule)
        masks = self.masks.compose(sharp, presence, valid, paster)
        backdrop, kl_background = self._backdrop(frame[:, 0], masks, memory, noise)
        seen = Drawn(alpha, presence, valid, place, what)
        picture = self._picture(Part(), frame[:, 0], step.source, seen, paster, masks, backdrop, context)
        slots = self.max_objects
        assert isinstance(steps.propagated, Beliefs)
        terms = {
            "nll": -picture.log_likelihood,
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
            "kl_background": kl_background,
            "mask_entropy": picture.mask_entropy,
            "loose_windows": picture.loose_windows,
        }
        return scene_of(steps, video_of([Part()], [picture], len(frame)), terms, context.detail)

    def _backdrop(self, frame: Tensor, masks: Masks, memory: _Memory, noise: Noise | None) -> tuple[Tensor, Tensor]:
        """The background's picture (B, 3, H, W) and what its latent costs (B,)."""
        q = self.background.posterior(masks.background, frame)
        z = q.sample(noise)
        history = [z] if memory.z_background is None else [memory.z_background, z]
        p = self.background.prior(torch.stack(history, dim=1))
        memory.z_background = z
        return self.background.decode(z), kl_gaussian(q, Gaussian(p.mean[:, -1], p.std[:, -1]))


def twins(model: Apex, node: Mapping[str, Any]) -> dict[str, Straightforward]:
    """What the benchmark compares with: as wide and with the same weights; one renders all cells of discovery.

    Args:
        model: whose weights are taken.
        node: the configuration that it was built from.
    """
    found = {}
    for name, top in (("straightforward", None), ("straightforward, renders as many", model.render_top)):
        own = {**node, "_target_": f"{Straightforward.__module__}.{Straightforward.__name__}", "render_top": top}
        twin = components.build(own, "model")
        twin.load_state_dict(model.state_dict())
        found[name] = twin
    return found

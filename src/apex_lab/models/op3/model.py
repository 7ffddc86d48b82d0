"""OP3: the model (op3.md)."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from apex_lab.models.op3.decoder import Decoded, Decoder
from apex_lab.models.op3.dynamics import Dynamics
from apex_lab.models.op3.likelihood import ImageGradients, Mixture, image_gradients, mixture
from apex_lab.models.op3.plan import Plan, PlannedStep, ScheduleKind, Weighting
from apex_lab.models.op3.posterior import UNIT_RAW, RawGaussian, kl, parameter_gradients
from apex_lab.models.op3.refinement import Memory, Refinement, Seen
from apex_lab.nn.tiled_conv import TiledWeights
from apex_lab.scene import Context, Noise, Scene, SceneModel

Count = Annotated[int, Field(gt=0)]
Positive = Annotated[float, Field(gt=0)]


class State(NamedTuple):
    """What the next frame needs; the dynamics step that it starts with computes all else again.

    Attributes:
        deterministic: d, (B, K, R).
        sample: z, (B, K, S).
        frames: how many there were.
    """

    deterministic: Tensor
    sample: Tensor
    frames: int


class Slots(NamedTuple):
    """The slots between two steps.

    Attributes:
        deterministic: d, written by the dynamics alone, (B, K, R).
        posterior, prior: of the stochastic state, (B, K, S).
        eps: noise of the sample, (B, K, S).
        sample: z, (B, K, S).
        memory: of the refinement.
    """

    deterministic: Tensor
    posterior: RawGaussian
    prior: RawGaussian
    eps: Tensor
    sample: Tensor
    memory: Memory

    def full(self) -> Float[Tensor, "B K Z"]:
        """[d; z], what decoder and dynamics see."""
        return torch.cat([self.deterministic, self.sample], dim=-1)


class Rendered(NamedTuple):
    """Slots decoded and compared with a frame: colours (B, K, 3, H, W), logits (B, K, H, W)."""

    decoded: Decoded
    colours: Tensor
    logits: Tensor
    mixture: Mixture


class Shown(NamedTuple):
    """What the `Scene` holds of a frame: all that is kept of it, so that memory grows by no more than the result.

    Attributes:
        masks: (B, K, H, W).
        reconstruction: RGB in [0, 1], (B, 3, H, W).
        appearance: d and the posterior's mean, not the sample: appearances are compared with one another. (B, K, R + S)
        means: each slot's RGB in [0, 1], (B, K, 3, H, W); None unless asked for.
    """

    masks: Tensor
    reconstruction: Tensor
    appearance: Tensor
    means: Tensor | None


class Op3(SceneModel):
    """Object-centric perception, prediction and planning, without actions.

    A scene model whose slots are found by iterative refinement: a network looks at what the slots draw, at how well
    that fits the frame and at the gradients of the loss, and replaces the slots' posterior. An interaction
    network predicts the slots of the next frame, where refinement starts again.

    No step of inference needs a graph (`Decoder.pull_back`), so under `no_grad`, where evaluation runs, a whole video
    needs the memory of one frame and of its `Scene`. Sampling
    stays on in evaluation: nothing but its noise tells slots apart.

    Args:
        image_size: H = W in pixels. [published: 64]
        slots: K. [published: 4 to 8; APEX paper: 5]
        stochastic: S, length of the sampled state.
        deterministic: R, length of the deterministic state.
        hidden: width of the refinement's LSTM.
        sigma: of the likelihood, in units of RGB in [0, 1].
        beta: weight of the KL in the gradients that refinement looks at; the same as the weight of the term `kl`.
        first_refinements: of a video's first frame.
        refinements: of every other frame.
        weighting: of the steps' losses, see `Plan`.
        schedule: of the steps in training, see `plan.listed`; `curriculum` reads the scheduled value `predictions`, the
            number of dynamics steps in a row. Evaluation refines every frame.
        loss_batch: what the loss is divided by before refinement looks at its gradients. It matters only where they are
            as small as the epsilons of the norms. None: the batch size, as published, which makes a video's result
            depend on its company in training; in evaluation a video counts as a batch of its own.
    """

    term_names = ("nll", "kl")
    changeable = ("slots", "first_refinements", "refinements")

    def __init__(
        self,
        image_size: Annotated[int, Field(ge=8)] = 64,
        slots: Count = 5,
        stochastic: Count = 64,
        deterministic: Count = 64,
        hidden: Count = 128,
        sigma: Positive = 0.1,
        beta: Annotated[float, Field(ge=0)] = 0.01,
        first_refinements: Count = 4,
        refinements: Annotated[int, Field(ge=0)] = 2,
        weighting: Weighting = "segment",
        loss_batch: Count | None = 4,
        schedule: ScheduleKind = "rprp",
    ) -> None:
        super().__init__()
        self.input_size = (image_size, image_size)
        self.slots, self.sigma, self.beta, self.loss_batch = slots, sigma, beta, loss_batch
        self.batch_statistics = loss_batch is None
        self.plan = Plan(first_refinements, refinements, weighting, schedule)
        self.capturable = schedule != "curriculum"
        if schedule == "curriculum":  # no other schedule reads the value, so none of them asks for it
            self.schedule_ranges = {"predictions": (1.0, 1000.0)}  # type: ignore[misc]
        # N(0, 1 / length), shared by all slots: noise alone tells them apart
        self.start_deterministic = nn.Parameter(torch.randn(deterministic) / deterministic**0.5)
        self.start_mean = nn.Parameter(torch.randn(stochastic) / stochastic**0.5)
        self.start_raw = nn.Parameter(torch.randn(stochastic) / stochastic**0.5)
        self.decoder = Decoder(deterministic + stochastic, image_size)
        self.dynamics = Dynamics(deterministic, stochastic)
        self.refinement = Refinement(stochastic, hidden, image_size)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        """RGB video in [0, 1] -> `Scene`; see the class."""
        if video.shape[-2:] != self.input_size:
            raise ValueError(
                f"the model was built for images of {self.input_size} px, the video has {tuple(video.shape[-2:])}: "
                "resize it or set model.image_size"
            )
        weights = self.decoder.prepare()
        before = 0 if context.state is None else context.state.frames
        slots = self._start(video, context)
        rendered: Rendered | None = None
        steps = self._steps(video.shape[1], before, context)
        losses: list[tuple[Tensor, Tensor]] = []
        frames: list[Shown] = []
        for step, following in zip(steps, [*steps[1:], None], strict=True):
            image, noise = video[:, step.frame], context.noise.at(step.frame)
            if step.kind == "dynamics":
                slots = self._predict(slots, noise)
            else:
                rendered = self._render(slots, image, weights) if rendered is None else rendered
                slots = self._refine(slots, rendered, image, weights, noise)
            rendered = self._render(slots, image, weights)
            losses.append((rendered.mixture.nll(), kl(slots.posterior, slots.prior).sum(1)))
            if following is None or following.frame != step.frame:
                frames.append(_shown(slots, rendered, context.detail))
        state = State(slots.deterministic, slots.sample, before + video.shape[1])
        return self._scene(frames, steps, losses, state)

    def _steps(self, frames: int, before: int, context: Context) -> list[PlannedStep]:
        """The steps of this pass."""
        if not self.training or before > 0:
            return self.plan.steps(frames, before)
        predictions = int(context.schedule["predictions"]) if self.plan.schedule == "curriculum" else 1
        return self.plan.training_steps(frames, predictions)

    def _start(self, video: Tensor, context: Context) -> Slots:
        """The slots before the first step."""
        b, k = len(video), self.slots
        mean, raw, deterministic = (
            start.expand(b, k, -1) for start in (self.start_mean, self.start_raw, self.start_deterministic)
        )
        prior = RawGaussian(torch.zeros_like(mean), torch.full_like(mean, UNIT_RAW))
        memory = self.refinement.start(b * k, mean)
        if context.state is not None:
            deterministic, sample, _ = context.state
            return Slots(deterministic, prior, prior, torch.zeros_like(mean), sample, memory)
        eps = context.noise.at(0).normal(mean)
        posterior = RawGaussian(mean, raw)
        return Slots(deterministic, posterior, prior, eps, posterior.sample(eps), memory)

    def _predict(self, slots: Slots, noise: Noise) -> Slots:
        """A dynamics step: what it predicts is both the prior and the posterior to start from."""
        deterministic, found = self.dynamics(slots.full())
        eps = noise.normal(found.mean)
        memory = self.refinement.start(len(slots.memory[0]), found.mean)
        return Slots(deterministic, found, found, eps, found.sample(eps), memory)

    def _render(self, slots: Slots, image: Tensor, weights: TiledWeights) -> Rendered:
        decoded = self.decoder(slots.full().flatten(0, 1), weights)
        colours, logits = (x.unflatten(0, (len(image), self.slots)) for x in decoded[:2])
        return Rendered(decoded, colours, logits, mixture(image, colours, logits, self.sigma))

    def _refine(self, slots: Slots, rendered: Rendered, image: Tensor, weights: TiledWeights, noise: Noise) -> Slots:
        """A refinement step."""
        gradients, to_mean, to_raw = self._gradients(slots, rendered, image, weights)
        seen = Seen(
            image,
            rendered.colours,
            rendered.logits,
            rendered.mixture,
            gradients,
            to_mean,
            to_raw,
            slots.posterior,
            slots.sample,
        )
        posterior, memory = self.refinement(seen, slots.memory)
        eps = noise.normal(posterior.mean)
        return slots._replace(posterior=posterior, eps=eps, sample=posterior.sample(eps), memory=memory)

    @torch.no_grad()
    def _gradients(
        self, slots: Slots, rendered: Rendered, image: Tensor, weights: TiledWeights
    ) -> tuple[ImageGradients, Tensor, Tensor]:
        """Gradients of the loss in the space of images and with respect to the posterior's mean and raw scale."""
        found = image_gradients(image, rendered.colours, rendered.mixture, self.sigma)
        pulled = self.decoder.pull_back(
            rendered.decoded, found.colours.flatten(0, 1), found.logits.flatten(0, 1), weights
        )
        to_sample = pulled.unflatten(0, slots.sample.shape[:2])[..., -slots.sample.shape[-1] :]
        to_mean, to_raw = parameter_gradients(slots.posterior, slots.prior, slots.eps, to_sample, self.beta)
        share = 1 / (self.loss_batch or (len(image) if self.training else 1))
        return ImageGradients(*(x * share for x in found)), to_mean * share, to_raw * share

    def _terms(self, steps: list[PlannedStep], losses: list[tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
        """Weighted means of the steps' losses: the published total is the batch's mean of nll + beta kl."""
        total = _weight(steps)
        shares = [step.weight / total for step in steps]
        named = zip(self.term_names, zip(*losses, strict=True), strict=True)
        return {
            name: torch.stack([value * share for value, share in zip(values, shares, strict=True)]).sum(0)
            for name, values in named
        }

    def _scene(
        self, frames: list[Shown], steps: list[PlannedStep], losses: list[tuple[Tensor, Tensor]], state: State
    ) -> Scene:
        """The result: every frame as it was after its last step."""
        masks = torch.stack([frame.masks for frame in frames], dim=1)
        means = [frame.means for frame in frames if frame.means is not None]
        return Scene(
            masks=masks,
            background=torch.zeros(self.slots, dtype=torch.bool, device=masks.device),
            ids=torch.arange(self.slots, device=masks.device).expand(*masks.shape[:2], -1),
            presence=masks.new_ones(masks.shape[:3]),
            appearance=torch.stack([frame.appearance for frame in frames], dim=1),
            reconstruction=torch.stack([frame.reconstruction for frame in frames], dim=1),
            terms=self._terms(steps, losses),
            terms_weight=_weight(steps),
            means=torch.stack(means, dim=1) if means else None,
            diagnostics=_by_kind(steps, losses),
            state=state,
        )


def _shown(slots: Slots, rendered: Rendered, detail: bool) -> Shown:
    """What is kept of a frame after its last step."""
    masks, colours = rendered.mixture.masks, rendered.colours
    return Shown(
        masks,
        (masks[:, :, None] * colours).sum(1).clamp(0, 1),
        torch.cat([slots.deterministic, slots.posterior.mean], dim=-1),
        colours.clamp(0, 1) if detail else None,
    )


def _weight(steps: list[PlannedStep]) -> float:
    """Sum of the steps' weights."""
    return sum(step.weight for step in steps)


def _by_kind(steps: list[PlannedStep], losses: list[tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Mean NLL per frame after dynamics steps (predictions) and after the last step of each frame."""
    found: dict[str, list[Tensor]] = {"nll_predicted": [], "nll_refined": []}
    for step, following, (nll, _) in zip(steps, [*steps[1:], None], losses, strict=True):
        if step.kind == "dynamics":
            found["nll_predicted"].append(nll)
        if following is None or following.frame != step.frame:
            found["nll_refined"].append(nll)
    return {name: torch.stack(values).detach().mean() for name, values in found.items() if values}

"""The step: one weight update, the same object in training and in the benchmark.

Forward, weighted sum of the loss terms, backward, clipping, optimiser, learning-rate schedule; eager or compiled, and
either of them captured as a CUDA graph. Everything that depends on progress (schedules, loss weights, learning rate)
lies in tensors that are written in place before each update, so a captured graph sees the changes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.optim import Optimizer

from apex_lab.base.errors import UserError
from apex_lab.inference.sizes import as_float, fitted
from apex_lab.nn.noise import RankNoise, mixed
from apex_lab.scene import Context, Scene, SceneModel
from apex_lab.training.capture import Captured, SideStream
from apex_lab.training.devices import adapt
from apex_lab.training.schedules import Constant

Values = Mapping[str, Callable[[int], float]]
"""Name -> schedule."""

Mode = Literal["eager", "compiled", "cuda graph", "compiled cuda graph"]
"""How a step is carried out: what a CUDA graph holds is eager or compiled."""

CAPTURED: tuple[Mode, ...] = ("cuda graph", "compiled cuda graph")

UNSCALED = Constant(1.0)
WARMUP = 3
"""Eager updates before a CUDA graph is captured, which PyTorch's documentation asks for."""


class Scheduled(nn.Module):
    """Scheduled numbers as 0-dim tensors on the module's device, written in place."""

    def __init__(self, schedules: Values) -> None:
        super().__init__()
        self.schedules = dict(schedules)
        for i, schedule in enumerate(self.schedules.values()):
            self.register_buffer(f"value_{i}", torch.tensor(float(schedule(0))), persistent=False)

    def write(self, step: int) -> None:
        """Sets all values to those of a step; filled on the device, so nothing waits for a copy."""
        for name, schedule in self.schedules.items():
            self[name].fill_(float(schedule(step)))

    def __getitem__(self, name: str) -> Tensor:
        return getattr(self, f"value_{list(self.schedules).index(name)}")

    def tensors(self) -> dict[str, Float[Tensor, ""]]:
        """Name -> the tensor itself."""
        return {name: self[name] for name in self.schedules}


class WeightUpdate(nn.Module):
    """One weight update of a model.

    Args:
        model: trained in place.
        schedules: the values of `Context.schedule`.
        weights: loss term -> its weight. A weight of 0 takes its term out, even where it is not finite (in a captured
            graph only a weight that is 0 at every step).
        lr_scale: factor of all of the optimiser's learning rates.
        clip_norm: gradients of all parameters together are scaled down to this norm; None leaves them.
        seed: of the noise.
        precision: 32 or "bf16-mixed".
        step: weight updates already made.
        mode: how forward, backward and update are carried out.
    """

    def __init__(
        self,
        model: SceneModel,
        schedules: Values,
        weights: Values,
        lr_scale: Callable[[int], float] = UNSCALED,
        clip_norm: float | None = None,
        seed: int = 0,
        precision: int | str = 32,
        step: int = 0,
        mode: Mode = "eager",
    ) -> None:
        super().__init__()
        self.model, self.schedules = model, Scheduled(schedules)
        self.weights = Scheduled({n: w for n, w in weights.items() if w != Constant(0.0)})
        self.terms = sorted(weights)
        self.lr_scale, self.seed, self.precision, self.step, self.mode = lr_scale, seed, precision, step, mode
        self.clip_norm = math.inf if clip_norm is None else clip_norm
        self.captured = mode in CAPTURED
        self.latest: dict[str, Tensor] = {}
        self._graph: Captured | None = None
        self._made: dict[torch.Size, int] = {}
        self._side: SideStream | None = None
        if mode.startswith("compiled"):
            model.compile()

    def objective(self, terms: Mapping[str, Float[Tensor, " B"]]) -> Float[Tensor, ""]:
        """The mean over videos of the weighted sum of terms.

        Raises:
            UserError: the model gives other terms than those that the configuration weighs.
        """
        optional = set(self.model.optional_terms)
        if set(terms) - optional != set(self.terms) - optional:
            raise UserError(f"The model gives the loss terms {sorted(terms)}, loss has {self.terms}.")
        # a captured graph is the same at every step; elsewhere a weight of 0 takes its term out of the step
        live = [name for name, weight in self.weights.schedules.items() if self.captured or weight(self.step) != 0]
        return torch.stack([terms[name].mean() * self.weights[name] for name in live]).sum()

    def write(self, optimizer: Optimizer | None = None) -> None:
        """Brings schedules, loss weights and learning rates to the present step."""
        self.schedules.write(self.step)
        self.weights.write(self.step)
        for group in optimizer.param_groups if optimizer is not None else ():
            rate = group["initial_lr"] * self.lr_scale(self.step)
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def forward(
        self,
        video: UInt8[Tensor, "B T 3 H W"],
        optimizer: Optimizer,
        rank: int = 0,
        ranks: int = 1,
        backward: Callable[[Tensor], object] = Tensor.backward,
        update: Callable[[], object] | None = None,
    ) -> None:
        """Makes one weight update; `latest` holds its values.

        Args:
            video: this rank's clips, on the device.
            optimizer: over the model's parameters.
            rank, ranks: which share of the global batch this is.
            backward: how gradients are computed (Lightning's `manual_backward` synchronises ranks); not used where the
                step is captured, which is for one rank.
            update: how the optimiser's step is made; by default `optimizer.step()`, as always where it is captured.
        """
        self.write(optimizer)
        torch.manual_seed(mixed(self.seed, self.step))
        noise = RankNoise(len(video), rank * len(video), ranks * len(video))
        if self.captured:
            self.latest = self._by_graph(video, optimizer, noise)
        else:
            self.latest = self._work(video, optimizer, noise, backward, update or optimizer.step)
        self.step += 1

    def _by_graph(self, video: Tensor, optimizer: Optimizer, noise: RankNoise) -> dict[str, Tensor]:
        """An update by the graph for videos of this shape; before there is one, by what it will hold."""

        def work(clips: Tensor) -> dict[str, Tensor]:
            return self._work(clips, optimizer, noise, Tensor.backward, optimizer.step)

        self._side = self._side or SideStream(video.device)
        made = self._made.get(video.shape, 0)
        self._made[video.shape] = made + 1
        if self._graph is not None and self._graph.shape != video.shape:
            self._graph, self.latest = None, {}  # a device holds the memory of one shape, not of a whole staircase
        if made < WARMUP:
            with self._side.ordered():
                return work(video)
        if self._graph is None:
            optimizer.zero_grad(set_to_none=True)
            self._graph = Captured(work, video, self._side)
        return self._graph(video)

    def _work(
        self,
        video: Tensor,
        optimizer: Optimizer,
        noise: RankNoise,
        backward: Callable[[Tensor], object],
        step: Callable[[], object],
    ) -> dict[str, Tensor]:
        """Forward, backward, clipping, update."""
        optimizer.zero_grad(set_to_none=True)
        with self.autocast():
            with torch.profiler.record_function("forward"):
                frames = fitted(as_float(video), self.model.input_size)
                unused = frozenset(self.model.optional_terms).difference(self.weights.schedules)
                scene: Scene = self.model(frames, Context(self.schedules.tensors(), noise, unused=unused))
            loss = self.objective(scene.terms)
        # Lightning makes the step inside autocast too, which is meant for the forward pass alone
        with torch.autocast(video.device.type, enabled=False):
            with torch.profiler.record_function("backward"):
                backward(loss)
            with torch.profiler.record_function("update"):
                norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.clip_norm)
                step()
        return {
            "train/loss": loss.detach(),
            **{f"train/{name}": term.detach().mean() for name, term in scene.terms.items()},
            **{f"diagnostics/{name}": value.detach() for name, value in scene.diagnostics.items()},
            "train/gradient_norm": norm.detach(),
        }

    @contextlib.contextmanager
    def autocast(self) -> Iterator[None]:
        """The precision of the run; without PyTorch's cache of cast weights, which a graph must not capture."""
        device = self.schedules_device()
        half = self.precision == "bf16-mixed"
        with torch.autocast(device.type, torch.bfloat16, enabled=half, cache_enabled=not self.captured):
            yield

    def schedules_device(self) -> torch.device:
        """Where the model is."""
        return next(self.model.parameters()).device


def named_parameters(model: nn.Module) -> list[tuple[str, nn.Parameter]]:
    """Names and parameters that are trained, as optimisers take them."""
    return [(name, weight) for name, weight in model.named_parameters() if weight.requires_grad]


def remember_rates(optimizer: Optimizer, captured: bool = False) -> Optimizer:
    """Notes each group's learning rate under the name of PyTorch's schedulers, and fits the optimiser to its device."""
    for group in optimizer.param_groups:
        group.setdefault("initial_lr", float(group["lr"]))
    adapt(optimizer, captured)
    return optimizer

"""What tests of the whole model share: APEX at its smallest, videos, and a look at what happens inside."""

from __future__ import annotations

import contextlib
import copy
import functools
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from unittest import mock

import torch
from hydra import compose, initialize_config_dir
from torch import Tensor, nn

from apex_lab.config.composition import conf_dir, plain
from apex_lab.models.apex import (
    Apex,
    ApexEncoder,
    ApexNormalisation,
    Background,
    FeatureGlimpses,
    MixtureLikelihood,
)
from apex_lab.models.apex.objective import DiscoveryPrior
from apex_lab.models.apex.objects import Proposals
from apex_lab.models.apex.rollout import State, Step
from apex_lab.scene import Context, Noise, Scene, Schedule, schedule_at

SIZE = 32
SCHEDULE = schedule_at(
    {
        "temperature": 0.7,
        "discovery_presence": 0.1,
        "carry": 1.0,
        "discover": 0.8,
        "sigma_fg_scale": 1.0,
        "sigma_bg_scale": 1.0,
    }
)
CONTEXT = Context(SCHEDULE, detail=True)


def parts() -> dict[str, Any]:
    """The components that APEX is given."""
    return {
        "encoder": ApexEncoder(8, (4, 4, 6, 8, 8, 8), (1, 1, 1, 1)),
        "glimpses": FeatureGlimpses(4, 6),
        "masks": ApexNormalisation(),
        "likelihood": MixtureLikelihood(),
        "background": Background(SIZE, 6, 6),
        "discovery_prior": DiscoveryPrior(),
    }


def tiny(**changes: object) -> Apex:
    """APEX with every part at its smallest, as it starts, but with presences that occur.

    About half of the cells of discovery are present (all or none for a `start_presence` near one or zero), and of the
    propagated objects most.
    """
    torch.manual_seed(0)
    sizes: dict[str, Any] = {
        "what": 6,
        "hidden": 12,
        "grid": 4,
        "max_objects": 3,
        "render_top": 4,
        "glimpse_size": 8,
        "decoder_width": 4,
        "start_presence": 0.5,
    }
    chosen = sizes | changes
    model = Apex(SIZE, **(parts() | chosen))
    start = torch.logit(torch.tensor(chosen["start_presence"])).item()
    spread(model.discovery.head_pres[-1], 20 * start, 4.0, functools.partial(propose, model))
    with torch.no_grad():
        model.propagation.head_pres[-1].bias.fill_(1.5)
    return model


def lively(**changes: object) -> Apex:
    """A tiny model whose objects move, cover each other, vanish and make room for others, whatever it starts as.

    All weights are drawn anew, so every network says something and has a memory; then the last layer of every head, in
    the order in which they are asked, is scaled to say what is written here about a video.
    """
    model = copy.deepcopy(_lively(**changes))
    torch.manual_seed(0)  # the same noise after it whether or not it was made before
    return model


@functools.cache
def _lively(**changes: object) -> Apex:
    model = tiny(**changes)
    redraw(model)
    discovery, propagation, what = model.discovery, model.propagation, model.appearance.what
    discover, roll_out = functools.partial(propose, model), functools.partial(follow, model)
    # means and standard deviations of what the heads say: of latents' means, then of their raw standard deviations
    spread(discovery.head_where, [-0.8, -0.8, 0.0, 0.0, *[-2.0] * 4], 0.5, discover)
    spread(model.appearance.head, [0.0] * what + [-2.0] * what, [1.0] * what + [0.5] * what, discover)
    spread(discovery.head_pres[-1], 0.0, 4.0, discover)
    found = discover().what.flatten(0, 2)
    spread(model.mask_decoder.head[0], 0.5, 1.0, lambda: model.mask_decoder(found))
    spread(model.colour_decoder.head[0], 0.0, 1.5, lambda: model.colour_decoder(found))
    spread(propagation.head_where[-1], [0.0] * 4 + [-2.0] * 4, [1.0] * 4 + [0.5] * 4, roll_out)
    for _ in range(3):  # about half of the objects vanish; who does decides who is asked next
        spread(propagation.head_pres[-1], 0.0, 4.0, roll_out)
    spread(propagation.prior_pres[-1], 0.0, 2.0, roll_out)
    spread(propagation.prior_where[-1], [0.0] * 4 + [-2.0] * 4, 0.5, roll_out)
    spread(propagation.prior_what[-1], [0.0] * what + [-1.0] * what, 0.5, roll_out)
    return model


def redraw(model: nn.Module) -> None:
    """Draws every weight anew, from its name, at a scale that keeps signals at theirs: nothing of a start remains."""
    norms = {f"{name}.weight" for name, part in model.named_modules() if isinstance(part, nn.GroupNorm)}
    with torch.no_grad():
        for name, p in model.named_parameters():
            noise = torch.randn(p.shape, generator=torch.Generator().manual_seed(zlib.crc32(name.encode())))
            if p.dim() == 1 or name.endswith("bias_image"):
                p.copy_(0.3 * noise + (1.0 if name in norms else 0.0))
            else:
                p.copy_(noise / p[0].numel() ** 0.5)


@torch.no_grad()
def propose(model: Apex) -> Proposals:
    """What discovery proposes in two videos; the means."""
    x = video(2, 5)
    features, _ = model.encoder(x)
    look_at, _ = model.glimpses.sources(x, features)
    found = model.discovery(features.flatten(0, 1), look_at.flatten(0, 1), model.glimpses, model.appearance, None)
    return found.over_time((2, 5), None)


@contextlib.contextmanager
def everything() -> Iterator[None]:
    """Nothing is left out that holds nothing, as on a GPU."""
    with contextlib.ExitStack() as stack:
        for module in ("nn.slots", *(f"models.apex.{name}" for name in ("model", "parts", "merging", "likelihood"))):
            stack.enter_context(mock.patch(f"apex_lab.{module}.may_look", return_value=False))
        yield


@torch.no_grad()
def follow(model: Apex) -> Step:
    """What the loop over time leaves of two videos in evaluation."""
    training = model.training
    with everything():
        steps = Inside(model.eval(), video(2, 5)).steps
    model.train(training)
    return steps


def spread(
    layer: nn.Module,
    mean: float | Sequence[float],
    std: float | Sequence[float],
    run: Callable[[], Proposals | Step | Tensor],
) -> None:
    """Scales a last layer so that each of its outputs has this mean and this standard deviation in a run.

    Its first call counts, over all that it is asked about; in a run of the loop over time, where its calls are the
    frames, what it says of slots that came into the frame with an object.
    """
    assert isinstance(layer, nn.Linear | nn.Conv2d)
    assert layer.bias is not None
    said: list[Tensor] = []
    hook = layer.register_forward_hook(lambda module, inputs, output: said.append(output.detach()))
    result = run()
    hook.remove()
    if isinstance(result, Step):
        rows = (said[0] if said[0].dim() == 4 else torch.stack(said, dim=1))[result.alive]  # priors: all frames at once
    else:
        rows = said[0].movedim(1 if isinstance(layer, nn.Conv2d) else -1, -1).flatten(0, -2)
    scale = torch.as_tensor(std) / rows.std(0)
    shift = torch.as_tensor(mean) - scale * rows.mean(0)
    assert scale.isfinite().all()  # it said something different each time
    with torch.no_grad():
        layer.weight.mul_(scale.reshape(-1, *[1] * (layer.weight.dim() - 1)))
        layer.bias.mul_(scale).add_(shift)


def video(b: int = 3, t: int = 4) -> torch.Tensor:
    return torch.rand(b, t, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))


class Inside:
    """Runs a model and keeps what its loop over time left behind: proposals, steps and the background's sample."""

    def __init__(self, model: Apex, x: torch.Tensor, schedule: Schedule = SCHEDULE) -> None:
        explain, decode = model._explain, model.background.decode
        proposals: list[Proposals] = []
        steps: list[Step] = []
        backdrops: list[torch.Tensor] = []

        def spy(
            video: torch.Tensor,
            found: Proposals,
            left: Step,
            context: Context,
            noise: Noise | None,
            state_with: Callable[[Tensor], State],
            evidence: Tensor | None,
        ) -> Scene:
            proposals.append(found)
            steps.append(left)
            return explain(video, found, left, context, noise, state_with, evidence)

        def listen(z: torch.Tensor) -> torch.Tensor:
            backdrops.append(z)
            return decode(z)

        model._explain, model.background.decode = spy, listen  # type: ignore[method-assign]
        try:
            self.scene = model(x, Context(schedule, detail=True))
        finally:
            model._explain, model.background.decode = explain, decode  # type: ignore[method-assign]
        self.proposals, self.steps = proposals[0], steps[0]
        self.z_background = backdrops[0].unflatten(0, x.shape[:2])


@functools.cache
def resolved(*words: str) -> dict[str, Any]:
    """A command line's configuration as plain values; nothing is built."""
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        return plain(compose("train", overrides=list(words)))

"""What tests of the whole model share: APEX at its smallest, videos, and a look at what happens inside."""

from __future__ import annotations

import functools
from typing import Any

import torch
from hydra import compose, initialize_config_dir

from apex_lab.config import conf_dir, plain
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
from apex_lab.models.apex.rollout import Step
from apex_lab.scene import Scene, schedule_at

SIZE = 32
SCHEDULE = schedule_at({"temperature": 0.7, "discovery_presence": 0.1, "carry": 1.0, "discover": 0.8})


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
    """APEX with every part at its smallest; random weights spread so that all presences occur."""
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
    model = Apex(SIZE, **(parts() | sizes | changes))
    with torch.no_grad():
        for p in model.discovery.head_pres.parameters():
            p.mul_(20.0)
    return model


def lively(**changes: object) -> Apex:
    """A tiny model whose objects move, cover each other, vanish and make room for others."""
    model = tiny(**changes)
    with torch.no_grad():
        model.encoder.over_time.from_input.weight.mul_(3.0)
        model.propagation.head_where[-1].weight.mul_(30.0)
        for prior in (model.propagation.prior_pres, model.propagation.prior_where, model.propagation.prior_what):
            prior[-1].weight.mul_(30.0)
        for decoder in (model.mask_decoder, model.colour_decoder):
            decoder.head[0].weight.mul_(5.0)
            decoder.head[0].bias.add_(0.5)
        # Presence: spread out, and centred so that about half of the objects vanish from frame to frame.
        head = model.propagation.head_pres
        head[-1].weight.mul_(1000.0)
        head[-1].bias.fill_(100.0)
        said: list[torch.Tensor] = []
        hook = head.register_forward_hook(lambda module, inputs, output: said.append(output))
        model.eval()(video(2, 5), SCHEDULE)
        hook.remove()
        head[-1].bias.sub_(torch.stack(said[1:]).median())
    return model


def video(b: int = 3, t: int = 4) -> torch.Tensor:
    return torch.rand(b, t, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))


class Inside:
    """Runs a model and keeps what its loop over time left behind: proposals, steps and the background's sample."""

    def __init__(self, model: Apex, x: torch.Tensor, schedule: dict[str, torch.Tensor] = SCHEDULE) -> None:
        explain, decode = model._explain, model.background.decode
        proposals: list[Proposals] = []
        steps: list[Step] = []
        backdrops: list[torch.Tensor] = []

        def spy(video: torch.Tensor, found: Proposals, left: Step) -> Scene:
            proposals.append(found)
            steps.append(left)
            return explain(video, found, left)

        def listen(z: torch.Tensor) -> torch.Tensor:
            backdrops.append(z)
            return decode(z)

        model._explain, model.background.decode = spy, listen  # type: ignore[method-assign]
        try:
            self.scene = model(x, schedule)
        finally:
            model._explain, model.background.decode = explain, decode  # type: ignore[method-assign]
        self.proposals, self.steps = proposals[0], steps[0]
        self.z_background = backdrops[0].unflatten(0, x.shape[:2])


@functools.cache
def resolved(*words: str) -> dict[str, Any]:
    """A command line's configuration as plain values; nothing is built."""
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        return plain(compose("train", overrides=list(words)))

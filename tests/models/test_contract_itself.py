"""Every check of `contract.py` passes a model that keeps the contract and finds the flaw of one that does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from apex_lab.scene import ABSENT, Context, Scene, SceneModel
from tests.models import contract
from tests.models.contract import CHECKS, Case, Check, name_of


class Toy(SceneModel):
    """A recurrent model of three components, the last of them background, with the flaw of that name if any."""

    term_names = ("error",)
    schedule_ranges = {"temperature": (0.1, 2.0)}  # noqa: RUF012

    def __init__(self, flaw: str = "") -> None:
        super().__init__()
        self.flaw = flaw
        self.has_posterior = flaw == "posterior"
        self.look, self.carry, self.colours = nn.Conv2d(3, 3, 3, padding=1), nn.Linear(3, 3), nn.Linear(3, 9)
        self.spare = nn.Linear(2, 2) if flaw in ("unused", "zero gradient") else None
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, video: Tensor, context: Context) -> Scene:
        b, t, flaw = *video.shape[:2], self.flaw
        h = video.new_zeros(b, 3) if context.state is None or flaw == "no state" else context.state
        temperature = video.new_ones(()) if flaw == "schedule unread" else context.schedule["temperature"]
        steps = []
        for frame in range(t):
            noise = context.noise if flaw == "noise of the whole pass" else context.noise.at(frame)
            eps = torch.randn_like(h) if flaw == "global noise" else noise.normal(h)
            if flaw == "ranks" and b < contract.VIDEOS:
                eps = noise.normal(h)
            h = torch.tanh(self.carry(h) + video[:, frame].mean(dim=(2, 3)) + 0.1 * eps * temperature)
            steps.append(h)
        state, slots = h, torch.stack(steps, dim=1)
        if flaw == "batch":
            slots = slots + slots.mean(dim=0, keepdim=True)
        if flaw == "order":
            slots = slots + torch.arange(b, dtype=slots.dtype)[:, None, None]
        if flaw == "memory":
            self.calls += 1
        logits = self.look(video.flatten(0, 1)).unflatten(0, (b, t)) + slots[..., None, None]
        masks = logits.softmax(dim=2) * (1.1 if flaw == "masks" else 1.0)
        means = self.colours(slots).sigmoid().unflatten(-1, (3, 3))
        drawn = (masks[:, :, :, None] * means[..., None, None]).sum(dim=2)
        error = (drawn - video).square().flatten(2).mean(dim=2).sum(dim=1)
        if flaw == "schedule unnamed":
            error = error * context.schedule["weight"]
        if flaw == "range":
            error = error + (temperature - 0.1).log()
        if self.spare is not None and flaw == "zero gradient":
            error = error + 0 * (self.spare.weight.sum() + self.spare.bias.sum())
        background = torch.tensor([False, False, True])
        scene = Scene(
            masks=masks,
            background=background,
            ids=torch.tensor([1, 1 if flaw == "ids" else 2, 0]).expand(b, t, 3),
            presence=torch.ones(b, t, 3) * (2 if flaw == "presence" else 1),
            appearance=slots[..., None],
            reconstruction=drawn.clamp(0, 1),
            terms={"mistake" if flaw == "term name" else "error": error},
            means=means[..., None, None].expand(b, t, 3, 3, *video.shape[-2:]) if context.detail else None,
            state=state,
        )
        if flaw == "absent":
            return replace(scene, ids=scene.ids.masked_fill(scene.ids == 1, ABSENT))
        if flaw == "detail":
            return replace(scene, windows=scene.masks[..., :4, 0])
        if flaw == "gradient under no_grad":
            with torch.enable_grad():
                return replace(scene, appearance=self.carry(slots)[..., None])
        return scene

    def posterior(self, scene: Scene, video: Tensor, context: Context) -> Tensor:
        return scene.masks / 2


FOUND_BY = {
    "presence": contract.check_shapes,
    "masks": contract.check_masks_sum_to_one,
    "absent": contract.check_masks_sum_to_one,
    "ids": contract.check_ids,
    "detail": contract.check_detail,
    "term name": contract.check_terms,
    "posterior": contract.check_posterior,
    "schedule unread": contract.check_schedule_names,
    "schedule unnamed": contract.check_schedule_names,
    "range": contract.check_schedule_ends,
    "global noise": contract.check_all_randomness_is_noise,
    "memory": contract.check_evaluation_repeats,
    "order": contract.check_order_of_videos,
    "batch": contract.check_independent_of_batch,
    "no state": contract.check_chunks,
    "noise of the whole pass": contract.check_chunks,
    "ranks": contract.check_ranks,
    "unused": contract.check_gradients,
    "zero gradient": contract.check_gradients,
    "gradient under no_grad": contract.check_no_grad,
}


@pytest.mark.parametrize("check", CHECKS, ids=name_of)
def test_a_model_that_keeps_the_contract(check: Check) -> None:
    check(Case(Toy(), frames=4, side=8))


@pytest.mark.parametrize("flaw", FOUND_BY)
def test_a_flaw_is_found(flaw: str) -> None:
    with pytest.raises(AssertionError, match=r"^Toy: "):
        FOUND_BY[flaw](Case(Toy(flaw), frames=4, side=8))


def test_a_gradient_may_be_zero_for_a_reason() -> None:
    spare = frozenset({"spare.weight", "spare.bias"})
    contract.check_gradients(Case(Toy("zero gradient"), frames=4, side=8, without_gradient=spare))


def test_values_of_schedules() -> None:
    case = Case(Toy(), frames=4, side=8)
    assert case.values() == {"temperature": 0.5}
    assert replace(case, schedule={"temperature": 1.5}).values() == {"temperature": 1.5}

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import lightning as L
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from apex_lab.base.errors import UserError
from apex_lab.training.learner import Learner, Stretches, as_float, foreground_share, noise_seed
from apex_lab.training.loggers import Curves
from apex_lab.training.schedules import Constant, Linear
from tests.tiny import Layers, SquaresModule

WEIGHTS = {"error": Constant(1.0), "spread": Linear(0.5, 1.5, 10)}


class Kept(Curves):
    """Curves that are kept instead of written."""

    def __init__(self) -> None:
        self.found: list[tuple[int, dict[str, float]]] = []

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        assert step is not None
        self.found.append((step, dict(metrics)))

    def save(self) -> None:
        """Nothing to save."""


def learner(step: int = 0, **options: Any) -> Learner:
    torch.manual_seed(5)
    model = Layers()
    return Learner(
        model,
        lambda weights: torch.optim.SGD(weights, lr=1e-4),
        {"noise": Constant(1.0)},
        WEIGHTS,
        step=step,
        **options,
    )


def fit(learner: Learner, steps: int, interval: int | None = None, validate: bool = True) -> Kept:
    data = SquaresModule()
    data.start_step, data.max_steps = learner.step, learner.step + steps
    kept = Kept()
    trainer = L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=-1,
        max_steps=steps,
        logger=[kept],
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        inference_mode=False,
    )
    trainer.fit(
        learner, Stretches(data.train_dataloader(), learner, interval), data.loader("val") if validate else None
    )
    return kept


def by_hand(steps: int, seed: int = 0, clip: float | None = None) -> tuple[Layers, list[dict[str, float]]]:
    """The same training written out."""
    torch.manual_seed(5)
    model = Layers()
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-4)
    data = SquaresModule()
    data.max_steps = steps
    rows = []
    for step, batch in enumerate(data.train_dataloader()):
        torch.manual_seed(noise_seed(seed, step))
        terms = model(batch["video"] / 255, {"noise": torch.tensor(1.0)}).terms
        loss = (terms["error"] + (0.5 + step / 10) * terms["spread"]).mean()
        optimizer.zero_grad()
        loss.backward()
        norm = torch.stack([p.grad.norm() for p in model.parameters() if p.grad is not None]).norm()
        if clip is not None and norm > clip:
            for p in model.parameters():
                assert p.grad is not None
                p.grad *= clip / norm
        optimizer.step()
        rows.append({"train/loss": loss.item(), "train/gradient_norm": norm.item()})
    return model, rows


@pytest.mark.parametrize("clip", [None, 0.5])
def test_training_is_what_is_written_out_by_hand(clip: float | None) -> None:
    ours = learner(gradient_clip_norm=clip)
    kept = fit(ours, 5, validate=False)
    model, rows = by_hand(5, clip=clip)
    assert ours.step == 5
    assert [step for step, _ in kept.found] == [1, 2, 3, 4, 5]
    for (_, found), row in zip(kept.found, rows, strict=True):
        assert found["train/loss"] == pytest.approx(row["train/loss"], rel=1e-5)
        assert found["train/gradient_norm"] == pytest.approx(row["train/gradient_norm"], rel=1e-4)
    for ours_, theirs in zip(ours.model.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(ours_, theirs, rtol=1e-4, atol=1e-6)


def test_the_learning_rate_follows_its_schedule_also_after_a_stop() -> None:
    def parameters(model: torch.nn.Module) -> torch.Tensor:
        return torch.nn.utils.parameters_to_vector(model.parameters()).detach()

    scale = Linear(1.0, 0.25, steps=4, delay=1)
    whole = learner(lr_scale=scale)
    kept = fit(whole, 6, validate=False)
    rates = [row["schedule/lr"] for _, row in kept.found]
    assert rates == pytest.approx([1e-4 * scale(step) for step in range(6)])

    first = learner(lr_scale=scale)
    fit(first, 4, validate=False)
    stored = first.optimizers(use_pl_optimizer=False).state_dict()

    def restored(weights: list[torch.nn.Parameter]) -> torch.optim.Optimizer:
        optimizer = torch.optim.SGD(weights, lr=1e-4)
        optimizer.load_state_dict(stored)
        return optimizer

    second = Learner(first.model, restored, {"noise": Constant(1.0)}, WEIGHTS, step=4, lr_scale=scale)
    fit(second, 2, validate=False)
    assert torch.equal(parameters(whole.model), parameters(second.model))
    assert not torch.equal(parameters(whole.model), parameters(constant_rate().model))


def constant_rate() -> Learner:
    """Six steps at one learning rate."""
    steady = learner()
    fit(steady, 6, validate=False)
    return steady


def test_a_row_has_every_term_schedule_and_diagnostic() -> None:
    kept = fit(learner(log_interval=2), 4, interval=2)
    steps = [(step, sorted(row)) for step, row in kept.found]
    train = sorted(["train/loss", "train/error", "train/spread", "train/gradient_norm", "train/frames_per_second"])
    train = sorted([*train, "diagnostics/largest", "schedule/lr", "schedule/noise"])
    val = ["loss", "error", "spread", "foreground_share", "ari", "ari_fg", "msc", "msc_fg"]
    val = sorted(f"val/{name}" for name in val)
    assert steps == [(1, train), (2, train), (2, val), (4, train), (4, val)]
    loss = kept.found[0][1]
    assert loss["train/loss"] == pytest.approx(loss["train/error"] + 0.5 * loss["train/spread"])


@pytest.mark.parametrize("start", [0, 2, 3, 4])
def test_validation_stays_at_the_same_steps_wherever_a_run_goes_on(start: int) -> None:
    kept = fit(learner(step=start), 8 - start, interval=3)
    assert [step for step, row in kept.found if "val/ari" in row] == [s for s in (3, 6, 8) if s > start]
    assert [step for step, row in kept.found if "train/loss" in row and step > start + 1] == list(range(start + 2, 9))


def test_validation_does_not_touch_the_noise_of_training() -> None:
    often, never = learner(), learner()
    fit(often, 6, interval=1)
    fit(never, 6, validate=False)
    assert all(torch.equal(a, b) for a, b in zip(often.parameters(), never.parameters(), strict=True))


def test_a_weight_of_zero_takes_a_term_out_even_where_it_is_not_finite() -> None:
    ours = learner()
    ours._weights = {"error": Constant(2.0), "spread": Constant(0.0)}
    terms = {"error": torch.tensor([1.0, 3.0]), "spread": torch.tensor([torch.nan, 1.0])}
    assert ours.loss(terms).item() == pytest.approx(4.0)


def test_other_terms_than_weighed_are_refused() -> None:
    with pytest.raises(UserError, match=r"gives the loss terms \['error'\], loss has \['error', 'spread'\]"):
        learner().loss({"error": torch.ones(2)})


def test_a_loss_that_is_not_finite_stops_with_a_reason() -> None:
    class Broken(Layers):
        def forward(self, video: Tensor, schedule: Mapping[str, Tensor]) -> Any:
            scene = super().forward(video, schedule)
            scene.terms["error"] = scene.terms["error"] * torch.nan
            return scene

    ours = learner()
    ours.model = Broken()
    with pytest.raises(UserError, match=r"train/loss is nan at step 1 \(not finite: train/loss, train/error, train/gr"):
        fit(ours, 3)


def test_noise_seeds_are_all_different_and_in_range() -> None:
    seeds = {noise_seed(seed, step) for seed in range(20) for step in range(500)}
    assert len(seeds) == 20 * 500
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_bytes_become_colours() -> None:
    video = torch.tensor([0, 51, 255], dtype=torch.uint8).reshape(1, 1, 3, 1, 1)
    torch.testing.assert_close(as_float(video).flatten(), torch.tensor([0.0, 0.2, 1.0]))


def test_stretches_hand_on_every_batch_once() -> None:
    ours = learner(step=2)
    stretches = Stretches([{"n": n} for n in range(2, 9)], ours, 3)
    found = []
    while batches := [batch["n"] for batch in stretches]:
        found.append(batches)
        ours.step += len(batches)
    assert found == [[2], [3, 4, 5], [6, 7, 8]]


def test_foreground_share_counts_pixels_that_are_not_background() -> None:
    video = torch.rand(2, 3, 3, 8, 8)
    model = Layers().eval()
    scene = model(video, {})
    identities = scene.segmentation()
    share = foreground_share(scene, identities)
    torch.testing.assert_close(share, (identities != 0).float().mean(dim=(1, 2, 3)))
    assert 0 < share[0] < 1


class Reads(TorchDispatchMode):
    """Counts how often the value of a tensor is read; each time, a GPU would have to be waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += function is torch.ops.aten._local_scalar_dense.default
        return function(*args, **(kwargs or {}))


def test_a_step_reads_no_value() -> None:
    ours = learner(gradient_clip_norm=1.0)
    data = SquaresModule()
    data.max_steps = 1
    batch = next(iter(data.train_dataloader()))
    with Reads() as reads:
        ours.training_step(batch, 0).backward()
        ours.configure_gradient_clipping(torch.optim.SGD(ours.parameters()))
    assert reads.count == 0
    with reads:
        ours.fetch()
        float(ours.latest["train/loss"])
    assert reads.count > 0

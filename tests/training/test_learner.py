from __future__ import annotations

from typing import Any

import lightning as L
import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from apex_lab.base.errors import UserError
from apex_lab.data import training_loader, whole_loader
from apex_lab.evaluation.score import foreground_share
from apex_lab.inference.sizes import as_float
from apex_lab.metrics import background_identities
from apex_lab.metrics.keys import VALIDATION_SCORES
from apex_lab.nn.noise import mixed
from apex_lab.scene import Context, Scene, schedule_at
from apex_lab.training.callbacks import LastValidation
from apex_lab.training.fit import resume_at
from apex_lab.training.learner import Learner
from apex_lab.training.loggers import Curves
from apex_lab.training.schedules import Constant, Linear
from apex_lab.training.update import WeightUpdate, named_parameters, remember_rates
from tests.tiny import Layers, SquaresSource

WEIGHTS = {"error": Constant(1.0), "spread": Linear(0.5, 1.5, 10)}
Named = list[tuple[str, nn.Parameter]]


class Kept(Curves):
    """Curves that are kept instead of written."""

    def __init__(self) -> None:
        self.found: list[tuple[int, dict[str, float]]] = []

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        assert step is not None
        self.found.append((step, dict(metrics)))

    def save(self) -> None:
        """Nothing to save."""


def sgd(parameters: Named) -> torch.optim.Optimizer:
    return torch.optim.SGD(parameters, lr=1e-4)


def learner(step: int = 0, log_interval: int = 1, model: Layers | None = None, **options: Any) -> Learner:
    torch.manual_seed(5)
    model = Layers() if model is None else model
    update = WeightUpdate(model, {"noise": Constant(1.0)}, WEIGHTS, step=step, **options)
    return Learner(update, sgd, log_interval)


def source() -> SquaresSource:
    data = SquaresSource()
    data.prepare()
    data.open()
    return data


def fit(learner: Learner, steps: int, interval: int | None = None) -> Kept:
    """Trains a learner for some steps as `apex_lab.training.fit.fit` does; no validation without an interval."""
    data, last = source(), learner.step + steps
    kept = Kept()
    trainer = L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        max_steps=last,
        val_check_interval=interval,
        check_val_every_n_epoch=None if interval is not None else 1,
        limit_val_batches=None if interval is not None else 0,
        logger=[kept],
        callbacks=[LastValidation(last)],
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        inference_mode=False,
    )
    resume_at(trainer, learner.step)
    batches = training_loader(data, 2, 0, learner.step, last)
    trainer.fit(learner, batches, whole_loader(data.sets["val"], 2) if interval is not None else None)
    return kept


def by_hand(steps: int, seed: int = 0, clip: float | None = None) -> tuple[Layers, list[dict[str, float]]]:
    """The same training written out."""
    torch.manual_seed(5)
    model = Layers()
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-4)
    rows = []
    for step, batch in enumerate(training_loader(source(), 2, 0, 0, steps)):
        torch.manual_seed(mixed(seed, step))
        terms = model(batch["video"] / 255, Context(schedule_at({"noise": 1.0}))).terms
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
    ours = learner(clip_norm=clip)
    kept = fit(ours, 5)
    model, rows = by_hand(5, clip=clip)
    assert ours.step == 5
    assert [step for step, _ in kept.found] == [1, 2, 3, 4, 5]
    for (_, found), row in zip(kept.found, rows, strict=True):
        assert found["train/loss"] == pytest.approx(row["train/loss"], rel=1e-5)
        assert found["train/gradient_norm"] == pytest.approx(row["train/gradient_norm"], rel=1e-4)
    for ours_, theirs in zip(ours.update.model.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(ours_, theirs, rtol=1e-4, atol=1e-6)


def test_the_learning_rate_follows_its_schedule_also_after_a_stop() -> None:
    def parameters(model: torch.nn.Module) -> torch.Tensor:
        return torch.nn.utils.parameters_to_vector(model.parameters()).detach()

    scale = Linear(1.0, 0.25, steps=4, delay=1)
    whole = learner(lr_scale=scale)
    kept = fit(whole, 6)
    rates = [row["schedule/lr"] for _, row in kept.found]
    assert rates == pytest.approx([1e-4 * scale(step) for step in range(6)])

    first = learner(lr_scale=scale)
    fit(first, 4)
    stored = first.raw_optimizer().state_dict()

    def restored(weights: Named) -> torch.optim.Optimizer:
        optimizer = sgd(weights)
        optimizer.load_state_dict(stored)
        return optimizer

    update = WeightUpdate(first.update.model, {"noise": Constant(1.0)}, WEIGHTS, lr_scale=scale, step=4)
    second = Learner(update, restored)
    fit(second, 2)
    assert torch.equal(parameters(whole.update.model), parameters(second.update.model))
    assert not torch.equal(parameters(whole.update.model), parameters(constant_rate().update.model))


def constant_rate() -> Learner:
    """Six steps at one learning rate."""
    steady = learner()
    fit(steady, 6)
    return steady


def test_a_row_has_every_term_schedule_and_diagnostic() -> None:
    kept = fit(learner(log_interval=2), 4, interval=2)
    steps = [(step, sorted(row)) for step, row in kept.found]
    train = sorted(["train/loss", "train/error", "train/spread", "train/gradient_norm", "train/frames_per_second"])
    train = sorted([*train, "diagnostics/largest", "schedule/lr", "schedule/noise"])
    val = ["loss", "error", "spread", "foreground_share", *VALIDATION_SCORES]
    val = sorted(f"val/{name}" for name in val)
    assert steps == [(1, train), (2, train), (2, val), (4, train), (4, val)]
    loss = kept.found[0][1]
    assert loss["train/loss"] == pytest.approx(loss["train/error"] + 0.5 * loss["train/spread"])
    last = kept.found[-1][1]
    assert last["val/loss"] == pytest.approx(last["val/error"] + 0.9 * last["val/spread"])


@pytest.mark.parametrize("start", [0, 2, 3, 4])
def test_validation_stays_at_the_same_steps_wherever_a_run_resumes(start: int) -> None:
    kept = fit(learner(step=start), 8 - start, interval=3)
    assert [step for step, row in kept.found if "val/ari" in row] == [s for s in (3, 6, 8) if s > start]
    assert [step for step, row in kept.found if "train/loss" in row and step > start + 1] == list(range(start + 2, 9))


def test_validation_does_not_touch_the_noise_of_training() -> None:
    often, never = learner(), learner()
    fit(often, 6, interval=1)
    fit(never, 6)
    assert all(torch.equal(a, b) for a, b in zip(often.parameters(), never.parameters(), strict=True))


@pytest.mark.parametrize("at_end", [False, True])
def test_validation_reads_the_values_of_its_step_or_the_last_ones(at_end: bool) -> None:
    class Seeing(Layers):
        evaluates_at_end = at_end

        def forward(self, video: Tensor, context: Context) -> Scene:
            seen.append((self.training, float(context.schedule["noise"])))
            return super().forward(video, context)

    seen: list[tuple[bool, float]] = []
    torch.manual_seed(5)
    schedule = Linear(1.0, 2.0, 10)
    fit(Learner(WeightUpdate(Seeing(), {"noise": schedule}, WEIGHTS, step=2), sgd), 4, interval=3)
    steps = [(True, 2), (False, 3), (True, 3), (True, 4), (True, 5), (False, 6)]
    values = [2.0 if at_end and not training else schedule(step) for training, step in steps]
    assert seen == [(training, pytest.approx(value)) for (training, _), value in zip(steps, values, strict=True)]


def test_a_weight_of_zero_takes_a_term_out_even_where_it_is_not_finite() -> None:
    update = WeightUpdate(Layers(), {"noise": Constant(1.0)}, {"error": Constant(2.0), "spread": Constant(0.0)})
    terms = {"error": torch.tensor([1.0, 3.0]), "spread": torch.tensor([torch.nan, 1.0])}
    assert update.objective(terms).item() == pytest.approx(4.0)


def test_other_terms_than_weighed_are_refused() -> None:
    with pytest.raises(UserError, match=r"gives the loss terms \['error'\], loss has \['error', 'spread'\]"):
        learner().update.objective({"error": torch.ones(2)})


def test_a_loss_that_is_not_finite_stops_with_a_reason() -> None:
    class Broken(Layers):
        def forward(self, video: Tensor, context: Context) -> Scene:
            scene = super().forward(video, context)
            scene.terms["error"] = scene.terms["error"] * torch.nan
            return scene

    with pytest.raises(UserError, match=r"train/loss is nan at step 1 \(not finite: train/loss, train/error, train/gr"):
        fit(learner(model=Broken()), 3)


def test_noise_seeds_are_all_different_and_in_range() -> None:
    seeds = {mixed(seed, step) for seed in range(20) for step in range(500)}
    assert len(seeds) == 20 * 500
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_bytes_become_colours() -> None:
    video = torch.tensor([0, 51, 255], dtype=torch.uint8).reshape(1, 1, 3, 1, 1)
    torch.testing.assert_close(as_float(video).flatten(), torch.tensor([0.0, 0.2, 1.0]))


def test_foreground_share_counts_pixels_that_are_not_background() -> None:
    torch.manual_seed(0)
    video = torch.rand(2, 3, 3, 8, 8)
    model = Layers().eval()
    scene = model(video, Context())
    identities = scene.segmentation()
    share = foreground_share(background_identities(scene), identities)
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
    torch.manual_seed(5)
    schedules = {"noise": Linear(1.0, 0.1, 10)}
    update = WeightUpdate(Layers(), schedules, WEIGHTS, Linear(1.0, 0.1, 10), clip_norm=1.0)
    ours = Learner(update, sgd)
    optimizer = remember_rates(sgd(named_parameters(update.model)))
    batch = next(iter(training_loader(source(), 2, 0, 0, 1)))
    with Reads() as reads:
        update(batch["video"], optimizer)
    assert reads.count == 0
    with reads:
        ours.fetch()
        float(update.latest["train/loss"])
    assert reads.count > 0

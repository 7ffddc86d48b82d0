"""Puts a model to work: from a goal image and a current image, a simulated arm rearranges the table.

python -m apex_lab.arrange checkpoint=outputs/<run>/seed_0
python -m apex_lab.arrange checkpoint=outputs/<run>/seed_0 video=[4/17]
python -m apex_lab.arrange perception=color_clusters tasks=[2] scenarios=20
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.arrangement import benchmark
from apex_lab.arrangement.benchmark import Benchmark
from apex_lab.arrangement.perception import Perception, Trained
from apex_lab.arrangement.task import Setting, Task, digest_of
from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText, one_line, sentence, shown, validate
from apex_lab.config import command_line as cli
from apex_lab.config import components
from apex_lab.config.building import build_model
from apex_lab.config.building import device as device_of
from apex_lab.config.job import explain_merged, refuse_missing
from apex_lab.config.schema import PathsPart
from apex_lab.evaluation.checkpoint import load, run_folder
from apex_lab.evaluation.files import Bad, find, listed, look
from sims.arrangement import scenario
from sims.arrangement.settings import Settings
from sims.errors import SimError

TASKS, SCENARIOS, SEED = (2, 3, 4), 150, 0
"""Of the paper's table."""

TRAINED = "trained"
"""The perception that needs a checkpoint."""


class ArrangeConfig(BaseModel):
    """The root of conf/arrange.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    checkpoint: str | list[str] | None
    perception: dict[str, Any]
    tasks: tuple[Annotated[int, Field(ge=1)], ...] = Field(min_length=1)
    scenarios: int = Field(ge=1)
    seed: int = Field(ge=0)
    video: tuple[str, ...]
    simulation: dict[str, Any]
    workers: int | None = Field(ge=1)
    accelerator: Literal["auto", "cpu", "gpu"]
    folder: PathText | None
    again: bool
    trust: bool
    paths: PathsPart


@dataclass(frozen=True)
class Arrangement:
    """One checked command: a perception of its own, or checkpoint files; `bad` ones cannot be read."""

    asked: ArrangeConfig
    name: str
    world: Settings
    videos: tuple[Task, ...] = ()
    files: tuple[Path, ...] = ()
    bad: Bad = field(default_factory=dict)


def main() -> None:
    """Entry point: `python -m apex_lab.arrange`."""
    cli.launch(cli.Command("arrange", check_arrangement, arrange, title, resumes=lambda job: not job.asked.again))


def title(job: Arrangement) -> str:
    """A command in a few words."""
    return ", ".join(str(file) for file in job.files) or job.name


def check_arrangement(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Arrangement:
    """Checks the command, looks into every checkpoint, and asks every perception whether it can do the task.

    Raises:
        UserError: unknown key, impossible value, a model without background, or a world without room; one sentence.
    """
    raw = {key: value for key, value in raw.items() if key != "hydra"}
    asked = validate(ArrangeConfig, raw, "")
    assert isinstance(asked, ArrangeConfig)
    refuse_missing(raw)
    device_of(asked.accelerator)
    world = _world(asked)
    if "_target_" not in asked.perception:
        raise UserError("perception has no _target_: choose perception=trained, oracle or color_clusters.")
    try:
        components.check(asked.perception, "perception")
    except UserError as error:
        explain_merged(str(error), overrides)
        raise
    perception = components.build(asked.perception, "perception")
    if not isinstance(perception, Perception):
        raise UserError(f"perception._target_ = {shown(asked.perception['_target_'])} is no Perception.")
    name = choices.get("perception", TRAINED)
    videos = tuple(_film(text, asked, world) for text in asked.video)
    for key, values in (("tasks", asked.tasks), ("video", videos)):
        if len(set(values)) < len(values):
            raise UserError(f"{key} = {shown(getattr(asked, key))} names one twice: name each once.")
    if not perception.needs_checkpoint:
        if asked.checkpoint is not None:
            raise UserError(f"perception={name} needs no checkpoint: leave one of the two out.")
        perception.ready(None, torch.device("cpu"))
        return Arrangement(asked, name, world, videos)
    if asked.checkpoint is None:
        raise UserError("checkpoint is missing: write checkpoint=..., perception=oracle or perception=color_clusters.")
    files, bad = find([asked.checkpoint] if isinstance(asked.checkpoint, str) else asked.checkpoint)
    if not files:
        raise UserError("checkpoint = [] names no file: give a .ckpt file or a run folder.")
    good, unread = look(files, asked.paths, trusted=asked.trust)
    bad |= unread
    for file in list(good):
        try:
            _ask(file, perception, asked)
        except UserError as error:
            good.remove(file)
            bad[file] = str(error)
    if not good:
        raise UserError(next(iter(bad.values())) if len(bad) == 1 else listed(bad, len(bad)))
    return Arrangement(asked, name, world, videos, tuple(good), bad)


def _world(asked: ArrangeConfig) -> Settings:
    """The settings of the simulation, tried by drawing a scenario of every task."""
    given = {key: value for key, value in asked.simulation.items() if value is not None}
    world = validate(Settings, given, "simulation")
    assert isinstance(world, Settings)
    for objects in asked.tasks:
        try:
            scenario.draw(asked.seed, objects, 0, world)
        except SimError as error:
            raise UserError(sentence(f"tasks = {shown(asked.tasks)}: {one_line(error)}")) from error
    return world


def _film(text: str, asked: ArrangeConfig, world: Settings) -> Task:
    """The scenario of a word such as "4/17"."""
    found = re.fullmatch(r"(\d+)/(\d+)", text, re.ASCII)
    if found is None:
        raise UserError(f"video = {shown(text)} is no scenario: write objects/index, such as video=[4/17].")
    task = Task(int(found[1]), int(found[2]))
    try:
        scenario.draw(asked.seed, task.objects, task.index, world)
    except SimError as error:
        raise UserError(sentence(f"video = {shown(text)}: {one_line(error)}")) from error
    return task


def _ask(file: Path, perception: Perception, asked: ArrangeConfig) -> None:
    """Whether the model of a checkpoint can do the task."""
    content, _ = load(file, asked.paths, trusted=asked.trust)
    try:
        perception.ready(content["inference"], torch.device("cpu"))
    except UserError as error:
        raise UserError(sentence(f"{file}: {one_line(error)}")) from error


def arrange(job: Arrangement) -> None:
    """Arranges with each perception; one that fails does not stop the others.

    Raises:
        UserError: some could not be used to the end.
    """
    if not job.files:
        benchmark.run(_of_perception(job))
        return
    failed, count = dict(job.bad), len(job.files) + len(job.bad)
    for number, file in enumerate(job.files):
        if count > 1:
            console.say(f"checkpoint {number + 1} of {len(job.files)}: {file}")
        try:
            benchmark.run(_of_file(job, file))
        except UserError as error:
            if count == 1:
                raise
            console.error(str(error))
            failed[file] = str(error)
        except Exception as error:
            if count == 1:
                raise
            failed[file] = faults.told(error)
            console.error(failed[file])
    if failed:
        raise UserError(listed(failed, count).replace("were not evaluated", "were not arranged with"))


def _of_perception(job: Arrangement) -> Benchmark:
    asked = job.asked
    base = Path(asked.folder) if asked.folder is not None else Path(asked.paths.outputs) / "arrange" / job.name
    return _benchmark(job, None, job.name, base, None)


def _of_file(job: Arrangement, file: Path) -> Benchmark:
    """The run's own folder takes what belongs in table 4: the paper's scenarios at the end of training."""
    asked = job.asked
    content, trained = load(file, asked.paths, trusted=asked.trust)
    run = run_folder(file)
    in_run = (run / "run.json").is_file()
    early = (content["training"] or {}).get("ended", False)
    learns = build_model(trained.config).needs_training
    ended = early or content["step"] >= trained.config.trainer.max_steps or not learns
    usual = (tuple(sorted(asked.tasks)), asked.scenarios, asked.seed) == (TASKS, SCENARIOS, SEED)
    usual &= job.world == Settings()
    usual &= components.build(asked.perception, "perception") == Trained()
    words = [trained.choices["model"], *([file.stem] if not in_run or file.name != "last.ckpt" or not ended else [])]
    if asked.folder is not None:
        base = Path(asked.folder) if len(job.files) == 1 else Path(asked.folder) / f"{file.stem}_{digest_of(file)[:8]}"
        return _benchmark(job, file, " ".join(words), base, None)
    into = run if in_run and file.name == "last.ckpt" and ended and usual else None
    base = run if in_run else Path(asked.paths.outputs) / "arrange" / f"{file.stem}_{digest_of(file)[:8]}"
    return _benchmark(job, file, " ".join(words), base, into)


def _benchmark(job: Arrangement, file: Path | None, name: str, base: Path, into: Path | None) -> Benchmark:
    asked = job.asked
    setting = Setting(
        perception=asked.perception,
        checkpoint=None if file is None else file.absolute(),
        digest=None if file is None else digest_of(file),
        trusted=asked.trust,
        device=str(device_of(asked.accelerator)),
        world=job.world,
        seed=asked.seed,
    )
    return Benchmark(
        setting=setting,
        title=name,
        tasks=asked.tasks,
        scenarios=asked.scenarios,
        videos=job.videos,
        workers=asked.workers,
        again=asked.again,
        base=base,
        into=into,
    )


if __name__ == "__main__":
    main()

"""Measures how fast a model trains and infers, in which part the time goes, and how much memory it takes.

python -m apex_lab.bench
python -m apex_lab.bench scale=cpu data.image_size=128 clips.batch_size=4
python -m apex_lab.bench +ablation=image_stn trainer=gpu trainer.compile=true

Every row is measured in a process of its own, on videos of moving sprites: no data set is needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import draft_of, make_folder, unwritable, write_json
from apex_lab.base.validation import PathText, shown, validate
from apex_lab.benchmark import printed as report
from apex_lab.benchmark.child import in_child
from apex_lab.benchmark.compare import Comparison, compare, twins_of
from apex_lab.benchmark.measure import Case, measure
from apex_lab.benchmark.work import clip_length
from apex_lab.config import command_line as cli
from apex_lab.config.building import build_model
from apex_lab.config.building import device as device_of
from apex_lab.config.job import Job, check_job
from apex_lab.config.schema import Config
from apex_lab.runs import provenance
from apex_lab.runs.folder import group_name
from apex_lab.training.update import CAPTURED, Mode


class BenchPart(BaseModel):
    """The keys of conf/bench.yaml below `bench`."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    modes: list[Mode] | None = Field(min_length=1)
    warmup: int = Field(ge=1)
    repeats: int = Field(ge=1)
    cpu_videos: int | None = Field(ge=1)
    cpu_frames: int | None = Field(ge=1)
    cpu_compiled_frames: int | None = Field(ge=1)
    memory: bool
    compare: bool
    output: PathText | None


@dataclass(frozen=True)
class Bench:
    """One checked command."""

    job: Job
    asked: BenchPart
    modes: tuple[Mode, ...]

    @property
    def output(self) -> Path:
        """The JSON file."""
        if self.asked.output is not None:
            return Path(self.asked.output)
        return (
            Path(self.job.config.paths.outputs) / "bench" / f"{group_name(self.job)}_seed_{self.job.config.seed}.json"
        )

    def batch(self, device: str, mode: Mode = "eager") -> tuple[int, int]:
        """Videos and frames that are timed on a device."""
        videos, frames = self.job.config.clips.batch_size, clip_length(self.job.config)
        if device != "cpu":
            return videos, frames
        most = self.asked.cpu_frames if mode == "eager" else self.asked.cpu_compiled_frames
        return min(videos, self.asked.cpu_videos or videos), min(frames, most or frames)


def main() -> None:
    """Entry point: `python -m apex_lab.bench`."""
    cli.launch(cli.Command("bench", check_bench, bench, title, resumes=lambda asked: False))


def title(asked: Bench) -> str:
    """A measurement in a few words."""
    return f"bench of {group_name(asked.job)}"


def check_bench(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Bench:
    """Checks a run as `train` does, and how it is to be measured.

    Raises:
        UserError: unknown key, impossible value, or nothing that could be measured; one sentence.
    """
    keys = raw.get("bench")
    if not isinstance(keys, Mapping):
        raise UserError(f"bench = {shown(keys)} is wrong: give bench.repeats=... and the like.")
    asked = validate(BenchPart, keys, "bench")
    assert isinstance(asked, BenchPart)
    job = check_job({key: value for key, value in raw.items() if key != "bench"}, choices, overrides)
    model = build_model(job.config)
    if model.needs_labels:
        raise UserError(f"model={choices.get('model')} reads the ground truth: choose a model that looks at the video.")
    for name in ("image_size", "frames"):
        if not isinstance(job.config.data.get(name), int):
            raise UserError(f"data.{name} is missing, and the size of the videos that are measured: give it a value.")
    if asked.output is not None and Path(asked.output).is_dir():
        raise UserError(f"bench.output = {shown(asked.output)} is a folder: name a file.")
    if asked.output is not None and Path(asked.output).exists() and not Path(asked.output).is_file():
        raise UserError(f"bench.output = {shown(asked.output)} is a device or the like: name a file.")
    modes = _modes(asked, job)
    named = next((mode for mode in modes if mode in CAPTURED and asked.modes is not None), None)
    if not model.capturable:
        if named is not None:
            raise UserError(f"bench.modes holds '{named}', and this model's steps follow its schedule: leave it out.")
        modes = tuple(mode for mode in modes if mode not in CAPTURED)
    if named is not None and device_of(job.config.trainer.accelerator).type == "cpu":
        raise UserError(f"bench.modes holds '{named}', but nothing is measured on a GPU: leave it out.")
    checked = Bench(job, asked, modes)
    _check_output(checked.output)
    return checked


def _check_output(path: Path) -> None:
    """Refuses, before minutes of measuring, a file that could not be written after them.

    A file is made and removed in the folder, or in the nearest one that is there already: permissions alone do not tell
    (root may write to /proc, and cannot).

    Raises:
        UserError: no file can be made there.
    """
    try:
        draft = draft_of(next(folder for folder in path.absolute().parents if folder.exists()) / path.name)
        draft.touch()
        draft.unlink()
    except OSError as error:
        raise unwritable(path, error) from error


def _modes(asked: BenchPart, job: Job) -> tuple[Mode, ...]:
    """What `bench.modes` names; else what `trainer.compile=...` on the command line names; else all."""
    if asked.modes is not None:
        return tuple(dict.fromkeys(asked.modes))
    if any(word.lstrip("+").startswith("trainer.compile=") for word in job.overrides):
        return ("compiled", "compiled cuda graph") if job.config.trainer.compile else ("eager", "cuda graph")
    return ("eager", "compiled", *CAPTURED)


def bench(asked: Bench) -> None:
    """Measures row by row, prints the table and writes everything to the JSON file.

    Raises:
        UserError: a measurement could not be made, or the file cannot be written.
    """
    config, devices = asked.job.config, _devices(asked.job.config)
    make_folder(asked.output.parent)
    commit, dirty = provenance.commit()
    result: dict[str, Any] = {
        "command": cli.command_line(),
        "commit": commit,
        "dirty": dirty,
        "versions": provenance.versions(),
        "hardware": provenance.hardware(torch.device(devices[-1])),
        "config": asked.job.raw,
        "bench": asked.asked.model_dump(),
        "rows": [],
        "whole_batch": None,
        "comparisons": [],
    }
    console.say(f"{title(asked)}: {report.about(result['hardware'], result['versions'])}")
    for case in _cases(asked, devices):
        row = in_child(measure, case)
        result["rows"].append(row)
        console.say(report.line(row))
    if asked.asked.memory and "cpu" in devices and build_model(config).needs_training:
        whole = Case(config, "cpu", "eager", True, config.clips.batch_size, clip_length(config), 0, 1, by_part=False)
        result["whole_batch"] = in_child(measure, whole)
        console.say(report.whole_batch(result["whole_batch"]))
    if asked.asked.compare and twins_of(config):
        for device in devices:
            settings = Comparison(config, device, *asked.batch(device), asked.asked.warmup, asked.asked.repeats)
            result["comparisons"].append(compare(settings))
            console.say(report.comparison(result["comparisons"][-1]))
    for table in report.tables(result["rows"]):
        console.say(table)
    write_json(asked.output, result)
    console.say(str(asked.output))


def _devices(config: Config) -> list[Literal["cpu", "cuda"]]:
    """The CPU and, where there is one, the GPU; the one alone that trainer.accelerator names."""
    if config.trainer.accelerator == "cpu":
        return ["cpu"]
    if config.trainer.accelerator == "gpu":
        return ["cuda"]
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def _cases(asked: Bench, devices: Sequence[str]) -> Iterator[Case]:
    """Rows in the order of the table: device, precision, mode, then training step and inference."""
    config = asked.job.config
    trains = build_model(config).needs_training
    for device in devices:
        half = config.model_copy(update={"trainer": config.trainer.model_copy(update={"precision": "bf16-mixed"})})
        twice = device == "cuda" and config.trainer.precision == 32
        for settings in (config, half) if twice else (config,):
            for mode in asked.modes:
                if mode in CAPTURED and device == "cpu":
                    continue
                for training in (True, False) if trains else (False,):
                    if mode in CAPTURED and not training:
                        continue
                    batch = asked.batch(device, mode)
                    yield Case(settings, device, mode, training, *batch, asked.asked.warmup, asked.asked.repeats)


if __name__ == "__main__":
    main()

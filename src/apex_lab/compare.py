"""Draws several trained models side by side on the same clips, as in the paper's figures.

python -m apex_lab.compare 'checkpoints=[outputs/<run>/seed_0, apex-p2d-cpu]'
python -m apex_lab.compare 'checkpoints=[a.ckpt, b.ckpt]' data=p2d clips=[0,7]
python -m apex_lab.compare 'checkpoints=[a.ckpt, b.ckpt]' video=examples/pushing.mp4
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText, shown, validate
from apex_lab.config import command_line as cli
from apex_lab.config import components
from apex_lab.config.building import device as device_of
from apex_lab.config.job import refuse_missing
from apex_lab.config.schema import PathsPart
from apex_lab.data import VideoSource
from apex_lab.evaluation.checkpoint import load
from apex_lab.evaluation.files import find, look
from apex_lab.evaluation.other_data import OtherData
from apex_lab.prediction.comparing import Cut, Model, clips_of_set, clips_of_videos, compare_clips
from apex_lab.prediction.load import segmenter_of
from apex_lab.runs import checkpoints
from apex_lab.videos import Source, find_videos
from apex_lab.videos.found import listed

OF_VIDEOS = {"fit": "crop", "start": 0, "every": 1, "frames": 20}
"""Keys of own videos alone, with their defaults."""


class CompareConfig(BaseModel):
    """The root of conf/compare.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    checkpoints: str | list[str] | None
    names: list[str] | None
    split: Literal["train", "val", "test"]
    clips: Annotated[int, Field(ge=1)] | Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    video: str | int | list[str | int] | None
    fit: Literal["crop", "letterbox"]
    start: int = Field(ge=0)
    every: int = Field(ge=1)
    frames: int = Field(ge=1, le=10_000)
    columns: int = Field(ge=1)
    folder: PathText | None
    accelerator: Literal["auto", "cpu", "gpu"]
    trust: bool
    paths: PathsPart
    seed: int = Field(default=0, ge=0)
    data: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class Comparison:
    """One checked command."""

    asked: CompareConfig
    files: tuple[Path, ...]
    videos: tuple[Source, ...] = ()
    data: OtherData = field(default_factory=OtherData)


def main() -> None:
    """Entry point: `python -m apex_lab.compare`."""
    cli.launch(
        cli.Command(
            "compare",
            check_comparison,
            compare,
            title,
            literal=("video", "folder"),
            of_checkpoint=("data.",),
            model_groups=False,
            resumes=lambda job: False,  # it writes when all is drawn
        )
    )


def title(job: Comparison) -> str:
    """A comparison in a few words."""
    return ", ".join(str(file) for file in job.files)


def check_comparison(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Comparison:
    """Checks the command, and looks into every checkpoint.

    Raises:
        UserError: unknown key, impossible value, or a checkpoint that cannot be used; one sentence.
    """
    asked = validate(CompareConfig, {key: value for key, value in raw.items() if key != "hydra"}, "")
    assert isinstance(asked, CompareConfig)
    refuse_missing(raw)
    patterns = [asked.checkpoints] if isinstance(asked.checkpoints, str) else asked.checkpoints
    if not patterns:
        raise UserError("checkpoints is missing: write 'checkpoints=[a.ckpt, outputs/<run>/seed_0]'.")
    device_of(asked.accelerator)
    given = [word.lstrip("+").partition("=")[0] for word in overrides if word.lstrip("+").startswith("data.")]
    data = OtherData(asked.data, tuple(key.removeprefix("data.") for key in given))
    files, bad = find(patterns)
    good, unread = look(files, asked.paths, data, asked.trust)
    for reason in (bad | unread).values():
        raise UserError(reason)
    if asked.names is not None and len(asked.names) != len(good):
        raise UserError(f"names holds {len(asked.names)} captions for {len(good)} checkpoints: give one for each.")
    videos: list[Source] = []
    if asked.video is None:
        for key, usual in OF_VIDEOS.items():
            if getattr(asked, key) != usual:
                raise UserError(f"{key} = {shown(getattr(asked, key))} goes with video=... alone: leave it out.")
    else:
        if data:
            raise UserError("video and data are both given: compare on one after the other.")
        many = asked.video if isinstance(asked.video, list) else [asked.video]
        videos = find_videos([str(each) for each in many])
    return Comparison(asked, tuple(good), tuple(videos), data)


def compare(job: Comparison) -> None:
    """Draws all clips with all models.

    Raises:
        UserError: a model, the data or a video that cannot be used.
    """
    asked = job.asked
    device = device_of(asked.accelerator)
    contents = [checkpoints.load(file, asked.trust) for file in job.files]
    captions = asked.names or _captions(job.files, contents)
    models, failed = [], dict[Source, str]()
    for file, content, caption in zip(job.files, contents, captions, strict=True):
        segmenter = segmenter_of(file, content, device, asked.fit, labels=asked.video is None)
        models.append(Model(caption, segmenter.predictor, segmenter.input_size))
    if asked.video is not None:
        cut = Cut(asked.fit, asked.start, asked.every, asked.frames)
        clips = clips_of_videos(job.videos, models, cut, failed)
    else:
        videos = _source(job).sets[asked.split]
        if not len(videos):
            raise UserError(f"split = {asked.split} holds no video: choose another one.")
        clips = clips_of_set(videos, asked.clips)
    paths = compare_clips(models, clips, _folder(job), asked.columns)
    if paths:
        console.say(f"{_many(len(models), 'model')} on {_many(len(paths), 'clip')}")
    if failed:
        raise UserError(listed(failed, len(job.videos), "compared"))


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _source(job: Comparison) -> VideoSource:
    """The data of the first checkpoint, or those that are given."""
    _, first = load(job.files[0], job.asked.paths, job.data, job.asked.trust)
    source = components.build(first.config.data, "data")
    if not isinstance(source, VideoSource):
        raise UserError(f"data._target_ = {first.config.data['_target_']!r} is not an apex_lab.data.VideoSource.")
    source.prepare()
    source.open()
    return source


def _captions(files: Sequence[Path], contents: Sequence[Mapping[str, Any]]) -> list[str]:
    """Model and ablation; where two are equal also the seed, where that is not enough the file."""
    plain = [" ".join(c["choices"][k] for k in ("model", "ablation") if k in c["choices"]) for c in contents]
    seeded = [f"{name} seed {c['config'].get('seed')}" for name, c in zip(plain, contents, strict=True)]
    for names in (plain, seeded):
        if all(names) and len(set(names)) == len(names):
            return names
    return [f"{name} {file.stem} {number}" for number, (name, file) in enumerate(zip(plain, files, strict=True), 1)]


def _folder(job: Comparison) -> Path:
    if job.asked.folder is not None:
        return Path(job.asked.folder)
    words = repr([str(file.resolve()) for file in job.files])
    return Path(job.asked.paths.outputs) / "compare" / hashlib.sha256(words.encode()).hexdigest()[:8]


if __name__ == "__main__":
    main()

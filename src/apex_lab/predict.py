"""Segments and tracks the objects of any video with a trained model.

python -m apex_lab.predict checkpoint=apex-p2d-cpu video=examples/pushing.mp4
python -m apex_lab.predict checkpoint=outputs/<run>/seed_0 video=clips/*.mp4 folder=masks masks=rle table=parquet
python -m apex_lab.predict checkpoint=apex-p2d-cpu video=0     a camera, until Ctrl-C
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console, faults, interrupts
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import make_folder, unwritable
from apex_lab.base.validation import PathText, validate
from apex_lab.config import command_line as cli
from apex_lab.config.building import device as device_of
from apex_lab.config.job import refuse_missing
from apex_lab.config.schema import PathsPart
from apex_lab.prediction.load import digest_of, one_file, segmenter_of
from apex_lab.prediction.work import Wanted, Weights, predict_video, unique_names
from apex_lab.runs import checkpoints
from apex_lab.videos import Source, find_videos
from apex_lab.videos.found import listed
from apex_lab.view.encoder import ffmpeg


class PredictConfig(BaseModel):
    """The root of conf/predict.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    checkpoint: str | None
    video: str | int | list[str | int] | None
    folder: PathText | None
    overlay: bool
    masks: Literal["png", "rle"] | None
    tracks: bool
    table: Literal["csv", "parquet"] | None
    appearance: bool
    fit: Literal["crop", "letterbox"]
    min_presence: float = Field(ge=0, le=1)
    every: int = Field(ge=1)
    frames: int | None = Field(ge=1)
    chunk: int = Field(ge=1)
    save_interval: int = Field(ge=1)
    again: bool
    accelerator: Literal["auto", "cpu", "gpu"]
    trust: bool
    model: dict[str, Any] = Field(default_factory=dict)
    paths: PathsPart


@dataclass(frozen=True)
class Prediction:
    """One checked command."""

    asked: PredictConfig
    file: Path
    videos: tuple[Source, ...]

    @property
    def wanted(self) -> Wanted:
        """What is written of each video."""
        return Wanted(**{name: getattr(self.asked, name) for name in Wanted.__dataclass_fields__})


def main() -> None:
    """Entry point: `python -m apex_lab.predict`."""
    cli.launch(
        cli.Command(
            "predict",
            check_prediction,
            predict,
            title,
            literal=("checkpoint", "video", "folder"),
            of_checkpoint=("model.",),
            model_groups=False,
            resumes=lambda job: not job.asked.again and not any(isinstance(video, int) for video in job.videos),
        )
    )


def title(job: Prediction) -> str:
    """A prediction in a few words."""
    return ", ".join(str(video) for video in job.videos)


def check_prediction(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Prediction:
    """Checks the command and finds the checkpoint and the videos; none of them is opened.

    Raises:
        UserError: unknown key, impossible value, nothing to do or to do it with; one sentence.
    """
    asked = validate(PredictConfig, {key: value for key, value in raw.items() if key != "hydra"}, "")
    assert isinstance(asked, PredictConfig)
    refuse_missing(raw)
    if asked.checkpoint is None:
        raise UserError("checkpoint is missing: write checkpoint=apex-p2d-cpu, or a .ckpt file or run folder.")
    if asked.video is None:
        raise UserError("video is missing: write video=FILE, a folder of pictures, a pattern with * or a camera (0).")
    if not (asked.overlay or asked.masks or asked.tracks or asked.table):
        raise UserError("overlay, masks, tracks and table are all switched off: leave one on.")
    device_of(asked.accelerator)
    if asked.overlay:
        ffmpeg()
    patterns = asked.video if isinstance(asked.video, list) else [asked.video]
    videos = find_videos([str(pattern) for pattern in patterns])
    if not videos:
        raise UserError("video = [] names no video: give a file, a folder, a pattern with * or a camera (0).")
    return Prediction(asked, one_file(asked.checkpoint), tuple(videos))


def predict(job: Prediction) -> None:
    """Predicts all videos; one that cannot be read does not stop the others.

    Raises:
        UserError: some could not be predicted.
        Interrupted: asked to stop; the same command resumes.
    """
    asked = job.asked
    content = checkpoints.load(job.file, asked.trust)
    segmenter = segmenter_of(job.file, content, device_of(asked.accelerator), asked.fit, changes=asked.model)
    weights = Weights(job.file, digest_of(job.file), asked.model)
    model = type(segmenter.predictor.model).__name__
    if not segmenter.tracks:
        console.warn(f"{model} does not track: objects are linked by the overlap of their masks from frame to frame.")
    if not segmenter.streams:
        console.warn(f"{model} needs whole videos at once: memory grows with their length.")
    folder = make_folder(_folder(job, weights))
    failed: dict[Source, str] = {}
    with _locked(folder):
        names = unique_names(job.videos)
        for number, source in enumerate(job.videos, 1):
            interrupts.check()
            if len(job.videos) > 1:
                console.say(f"video {number} of {len(job.videos)}: {source}")
            try:
                console.say(
                    str(predict_video(segmenter, weights, job.wanted, source, folder, names[source], asked.again))
                )
            except UserError as error:
                failed[source] = str(error)
            except Exception as error:  # noqa: BLE001 - reported below; the others must still be done
                failed[source] = faults.told(error, str(source))
            if source in failed and len(job.videos) > 1:
                console.error(failed[source])
    if failed:
        raise UserError(listed(failed, len(job.videos), "predicted"))


def _folder(job: Prediction, weights: Weights) -> Path:
    if job.asked.folder is not None:
        return Path(job.asked.folder)
    changes = "".join(f"_{name}_{value}" for name, value in sorted(job.asked.model.items()))
    return Path(job.asked.paths.outputs) / "predict" / f"{job.file.stem}_{weights.sha256[:8]}{changes}"


def _locked(folder: Path) -> FileLock:
    """The lock of a folder, taken.

    Raises:
        Busy: another process has it.
    """
    lock = FileLock(str(folder / ".lock"))
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise Busy(f"{folder} is being worked on by another process: wait for it, or give another folder=.") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    return lock


if __name__ == "__main__":
    main()

"""From a checkpoint to a `Segmenter`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence
from apex_lab.inference.loading import trained_model
from apex_lab.inference.predictor import Predictor
from apex_lab.inference.segmenter import Segmenter
from apex_lab.runs import checkpoints
from apex_lab.runs.checkpoint_files import find
from apex_lab.scene import schedule_at
from apex_lab.videos import Fit


def load(
    checkpoint: str | os.PathLike[str],
    *,
    device: str | torch.device | None = None,
    fit: Fit = "crop",
    full_size: bool = True,
    detail: bool = False,
    trust: bool = False,
) -> Segmenter:
    """A trained model for videos of any size.

    Args:
        checkpoint: a .ckpt file, a run folder (its last checkpoint), or the name of shipped weights: "apex-p2d-cpu".
        device: such as "cpu" or "cuda"; None: a GPU where there is one.
        fit: how frames of another shape than the model's input are seen: "crop" (their middle) or "letterbox" (all,
            between black bars).
        full_size: scenes have the size of the frames; False: that of the model's input, which takes less memory.
        detail: fill `Scene.windows` and `Scene.means` too.
        trust: build classes that are not apex_lab's own, because you trust whoever made the checkpoint.

    Raises:
        apex_lab.UserError: no such checkpoint, one that is damaged, or one that cannot be used on videos alone.
    """
    file = one_file(os.fspath(checkpoint))
    return segmenter_of(file, checkpoints.load(file, trust), _device(device), fit, full_size, detail)


def one_file(checkpoint: str) -> Path:
    """The one checkpoint file that is meant.

    Raises:
        UserError: none, or several.
    """
    files, bad = find([checkpoint])
    if bad:
        raise UserError(next(iter(bad.values())))
    if len(files) > 1:
        raise UserError(f"checkpoint = {checkpoint} means {len(files)} checkpoints: give one, such as {files[0]}.")
    return files[0]


def segmenter_of(
    file: Path,
    content: Mapping[str, Any],
    device: torch.device,
    fit: Fit,
    full_size: bool = True,
    detail: bool = False,
    labels: bool = False,
    changes: Mapping[str, Any] | None = None,
) -> Segmenter:
    """The model of a checkpoint that has been read.

    Args:
        file: for messages.
        content: as `checkpoints.load` gives it.
        device: where the model runs.
        fit, full_size, detail: as of `load`.
        labels: models that read the ground truth are allowed.
        changes: arguments of the model with other values than in the checkpoint, as of `trained_model`.

    Raises:
        UserError: the model cannot be built, or reads the ground truth.
    """
    inference = content["inference"]
    try:
        model = trained_model(inference, changes)
    except UserError as error:
        raise UserError(sentence(f"{file}: {one_line(error)}")) from error
    if model.needs_labels and not labels:
        raise UserError(
            f"{file} holds {type(model).__name__}, which reads the ground truth: give a model that looks at videos."
        )
    predictor = Predictor(
        model, schedule_at(inference["schedule"], device), device, inference["precision"], seed=inference["seed"]
    )
    return Segmenter(predictor, model.input_size or _trained_size(file, content), fit, full_size, detail)


def digest_of(file: Path) -> str:
    """SHA-256 of a file."""
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _trained_size(file: Path, content: Mapping[str, Any]) -> tuple[int, int]:
    """The size of the data that a model of any size was trained on."""
    size = content["config"].get("data", {}).get("image_size")
    if not isinstance(size, int) or size < 1:
        raise UserError(f"{file} does not say which image size it was trained on (data.image_size): use another one.")
    return size, size


def _device(name: str | torch.device | None) -> torch.device:
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UserError(sentence(f"device = {str(name)!r} cannot be used: {one_line(error)}")) from error
    return device

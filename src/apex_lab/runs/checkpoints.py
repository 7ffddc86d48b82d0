"""Checkpoint files: weights with the configuration that built the model, and what training needs to resume.

A checkpoint is a dictionary of plain values and tensors, readable with `torch.load(path, weights_only=True)`:

    format     version of this layout (`apex_lab.config.upgrades.FORMAT`)
    step       weight updates made
    inference  all that a prediction needs: `model` (the configuration node that builds it), `weights` (its state_dict),
               `schedule` (name -> value at this step), `attributes` (of `SceneModel`), `precision`, `seed`
    config     resolved configuration (plain containers)
    choices    configuration group -> word chosen
    training   all that resuming needs besides: states of optimiser and callbacks, seconds so far, best score, data's
               fingerprint, `ended` (whether training is over), `record` (what run.json would lose with the file); None
               where only evaluation is meant
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from apex_lab.base import faults
from apex_lab.base.errors import UserError
from apex_lab.base.files import replacing
from apex_lab.base.machine import bounded_memory
from apex_lab.base.outlines import outline
from apex_lab.base.validation import LARGEST, shown
from apex_lab.config import components, trust
from apex_lab.config.building import build_schedules
from apex_lab.config.schema import Config
from apex_lab.config.upgrades import FORMAT, upgraded
from apex_lab.runs.record import Kept
from apex_lab.scene import SceneModel
from apex_lab.training.schedules import in_evaluation

_KEYS = {
    1: {"format", "step", "weights", "config", "choices", "training"},
    2: {"format", "step", "inference", "config", "choices", "training"},
}
"""Format -> entries."""

ATTRIBUTES = ("tracks", "streams", "needs_labels", "needs_training", "has_posterior", "input_size")
"""Of `SceneModel`, kept beside the weights."""


def inference_part(config: Config, model: SceneModel, step: int) -> dict[str, Any]:
    """The `inference` entry of a checkpoint of a model after `step` weight updates."""
    return {
        "model": config.model,
        "weights": {name: value.detach().cpu() for name, value in model.state_dict().items()},
        "schedule": in_evaluation(build_schedules(config), model, step),
        "attributes": {name: getattr(model, name) for name in ATTRIBUTES},
        "precision": config.trainer.precision,
        "seed": config.seed,
    }


def save(path: Path, checkpoint: dict[str, Any], keep_previous: bool = False) -> None:
    """Writes a checkpoint; until all of it is on the disk, the file that was there before stays.

    Args:
        path: where to.
        checkpoint: the entries of the module's docstring, without `format`.
        keep_previous: leaves the file that was there before beside the new one, as `previous(path)`.

    Raises:
        UserError: the disk is full or the folder cannot be written.
    """
    content = {"format": FORMAT, **checkpoint}
    assert set(content) == _KEYS[FORMAT]
    with replacing(path, keep=previous(path) if keep_previous else None) as file:
        torch.save(content, file)


def holds(value: object) -> bool:
    """Whether a checkpoint gives a value back: plain values, containers of them, and tensors."""
    content = io.BytesIO()
    try:
        torch.save(value, content)
        content.seek(0)
        torch.load(content, weights_only=True)
    except (pickle.PicklingError, pickle.UnpicklingError, AttributeError, TypeError, RuntimeError):
        return False
    return True


def previous(path: Path) -> Path:
    """Where the checkpoint before the last one lies."""
    return path.with_name(f"previous{path.suffix}")


def load(path: Path, trusted: bool = False, known: Iterable[str] = ()) -> dict[str, Any]:
    """Reads a checkpoint to the CPU and checks that it is whole (every stored block has a checksum).

    Args:
        path: the file.
        trusted: it may name any class; else only the project's own (`apex_lab.config.trust`).
        known: names of further classes that are allowed.

    Raises:
        UserError: missing, damaged, no checkpoint of ours, or one that names classes that are not allowed.
    """
    with _reading(path):
        content = _upgraded(_read(path, trusted, known, whole=True))
        _check_weights(path, content["inference"]["weights"])
        return content


def weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights of a checkpoint alone. Nothing that the file names is built, so its author need not be trusted.

    Raises:
        UserError: as `load`, but for classes.
    """
    with _reading(path):
        content = _read(path, trusted=True, known=(), whole=True)
        found: dict[str, torch.Tensor] = {**content, **_inside(content)}["weights"]
        _check_weights(path, found)
        return found


def _check_weights(path: Path, weights: Mapping[str, Any]) -> None:
    strange = [name for name, weight in weights.items() if not isinstance(weight, torch.Tensor)]
    if strange:
        raise UserError(f"{path} is no apex_lab checkpoint (its weight {strange[0]} is no tensor): use another one.")
    sick = [name for name, weight in weights.items() if not torch.isfinite(weight).all()]
    if sick:
        raise UserError(f"{path} holds weights that are not finite ({sick[0]}): its run diverged; use an earlier one.")


def glance(path: Path, trusted: bool = False) -> dict[str, Any]:
    """What a checkpoint says about itself; its weights are neither read nor checked, so this takes milliseconds.

    Args:
        path: the file.
        trusted: as of `load`.

    Returns:
        `step`, `config` (of today's format) and `choices`.

    Raises:
        UserError: as `load`, as far as it shows without the weights.
    """
    with _reading(path):
        content = _read(path, trusted, (), whole=False)
        return {key: content[key] for key in ("step", "config", "choices")}


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Inside, whatever a strange file makes the readers raise becomes a sentence, and memory is bounded.

    Raises:
        UserError: the sentence.
    """
    try:
        with bounded_memory():
            yield
    except UserError:
        raise
    except Exception as error:  # what is raised for damaged bytes has no common class
        raise UserError(f"{path} is damaged or no checkpoint ({type(error).__name__}): use another one.") from error


def _read(path: Path, trusted: bool, known: Iterable[str], whole: bool) -> dict[str, Any]:
    """The content of a checkpoint of any format, with its configuration in today's; without tensors unless `whole`."""
    if not path.is_file():
        raise UserError(f"There is no checkpoint at {path}.")
    if not zipfile.is_zipfile(path):
        raise UserError(
            f"{path} is no checkpoint, or its end is missing: give a .ckpt file of a run, or the run's folder."
        )
    with zipfile.ZipFile(path) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):  # it may inflate to anything
            raise UserError(f"{path} is no apex_lab checkpoint (its parts are compressed): use another one.")
        broken = archive.testzip() if whole else None
    if broken is not None:
        raise UserError(f"{path} is damaged (checksum of {broken}): use another checkpoint.")
    content = torch.load(path, map_location="cpu", weights_only=True) if whole else outline(path)
    if not isinstance(content, dict) or "format" not in content or "weights" not in {**content, **_inside(content)}:
        raise UserError(f"{path} is no apex_lab checkpoint: give a .ckpt file of a run, or the run's folder.")
    if type(content["format"]) is not int or content["format"] not in _KEYS:
        raise UserError(
            f"{path} has format {shown(content['format'])}, this version of apex_lab reads "
            f"{', '.join(map(str, _KEYS))}: use the version that wrote it."
        )
    if set(content) != _KEYS[content["format"]]:
        raise UserError(f"{path} is no apex_lab checkpoint: give a .ckpt file of a run, or the run's folder.")
    missing = _missing(content)
    if missing:
        raise UserError(f"{path} is no apex_lab checkpoint (its {missing} is none): use another one.")
    try:
        config = upgraded(content["config"], content["format"])
    except Exception as error:
        raise UserError(f"{path} holds no whole configuration ({faults.cited(error)}): use another one.") from error
    if not trusted:
        trust.check({"config": config, "inference": {"model": _inside(content).get("model")}}, str(path), known)
    return {**content, "config": config}


def _inside(content: dict[str, Any]) -> dict[str, Any]:
    inside = content.get("inference")
    return inside if isinstance(inside, dict) else {}


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, arbitrary_types_allowed=True)


class _Inference(_Part):
    model: dict[str, Any]
    weights: dict[str, Any]
    schedule: dict[str, float]
    precision: Literal[32, "bf16-mixed"]
    seed: int = Field(ge=0, lt=LARGEST)


class _Training(_Part):
    optimizer: dict[str, Any]
    callbacks: dict[str, Any] = {}
    best: float | None = None
    seconds: float = Field(default=0.0, ge=0.0, lt=1e12)
    data_fingerprint: str | None = None
    ended: bool = False
    record: Kept = Kept()


class _Content(_Part):
    step: int = Field(ge=0, lt=LARGEST)
    config: dict[str, Any]
    choices: dict[str, str]
    training: _Training | None


class _Content1(_Content):
    weights: dict[str, Any]


class _Content2(_Content):
    inference: _Inference


_CONTENTS: dict[int, type[_Content]] = {1: _Content1, 2: _Content2}
"""Format -> what must hold of its entries."""


def _missing(content: dict[str, Any]) -> str | None:
    """The first entry that is not what it must be."""
    try:
        _CONTENTS[content["format"]].model_validate(content)
    except ValidationError as error:
        return ".".join(map(str, error.errors(include_url=False, include_input=False)[0]["loc"]))
    return None


def _upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint of an older format, whose configuration is upgraded, in today's layout."""
    if content["format"] == FORMAT:
        return content
    config, step = content["config"], content["step"]
    schedules = {name: components.build(node, f"schedule.{name}") for name, node in config["schedule"].items()}
    return {
        "format": FORMAT,
        "step": step,
        "inference": {
            "model": config["model"],
            "weights": content["weights"],
            "schedule": {name: float(schedule(step)) for name, schedule in schedules.items()},
            "attributes": {},
            "precision": config["trainer"]["precision"],
            "seed": config["seed"],
        },
        "config": config,
        "choices": content["choices"],
        "training": content["training"],
    }

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
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from apex_lab.base.errors import UserError
from apex_lab.base.files import replacing, unwritable
from apex_lab.base.validation import one_line
from apex_lab.config import components, trust
from apex_lab.config.schema import Config, build_schedules
from apex_lab.config.upgrades import FORMAT, upgraded
from apex_lab.runs.outlines import outline
from apex_lab.scene import SceneModel

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
        "schedule": {name: float(schedule(step)) for name, schedule in build_schedules(config).items()},
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
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # torch's writer hides the operating system's error behind its own
            if isinstance(error.__context__, OSError):
                raise unwritable(path, error.__context__) from error
            raise


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
    content = _upgraded(_read(path, trusted, known, whole=True))
    weights = content["inference"]["weights"]
    strange = [name for name, weight in weights.items() if not isinstance(weight, torch.Tensor)]
    if strange:
        raise UserError(f"{path} is no apex_lab checkpoint (its weight {strange[0]} is no tensor): use another one.")
    sick = [name for name, weight in weights.items() if not torch.isfinite(weight).all()]
    if sick:
        raise UserError(f"{path} holds weights that are not finite ({sick[0]}): its run diverged; use an earlier one.")
    return content


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
    content = _read(path, trusted, (), whole=False)
    return {key: content[key] for key in ("step", "config", "choices")}


def _read(path: Path, trusted: bool, known: Iterable[str], whole: bool) -> dict[str, Any]:
    """The content of a checkpoint of any format, with its configuration in today's; without tensors unless `whole`."""
    if not path.is_file():
        raise UserError(f"There is no checkpoint at {path}.")
    try:
        if not zipfile.is_zipfile(path):
            raise UserError(
                f"{path} is no checkpoint, or its end is missing: give a .ckpt file of a run, or the run's folder."
            )
        if whole:
            with zipfile.ZipFile(path) as archive:
                broken = archive.testzip()
            if broken is not None:
                raise UserError(f"{path} is damaged (checksum of {broken}): use another checkpoint.")
        content = torch.load(path, map_location="cpu", weights_only=True) if whole else outline(path)
    except UserError:
        raise
    except Exception as error:  # what is raised for damaged bytes has no common class
        raise UserError(f"{path} is damaged or no checkpoint ({type(error).__name__}): use another one.") from error
    if not isinstance(content, dict) or "format" not in content or "weights" not in {**content, **_inside(content)}:
        raise UserError(f"{path} is no apex_lab checkpoint: give a .ckpt file of a run, or the run's folder.")
    if content["format"] not in _KEYS:
        raise UserError(
            f"{path} has format {content['format']}, this version of apex_lab reads {', '.join(map(str, _KEYS))}: "
            "use the version that wrote it."
        )
    if set(content) != _KEYS[content["format"]]:
        raise UserError(f"{path} is no apex_lab checkpoint: give a .ckpt file of a run, or the run's folder.")
    missing = _missing(content)
    if missing:
        raise UserError(f"{path} is no apex_lab checkpoint (its {missing} is none): use another one.")
    try:
        config = upgraded(content["config"], content["format"])
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} holds no whole configuration ({one_line(error)}): use another one.") from error
    if not trusted:
        trust.check({"config": config, "inference": {"model": _inside(content).get("model")}}, str(path), known)
    return {**content, "config": config}


def _inside(content: dict[str, Any]) -> dict[str, Any]:
    inside = content.get("inference")
    return inside if isinstance(inside, dict) else {}


_OF_INFERENCE = {"model": dict, "weights": dict, "schedule": dict, "precision": object, "seed": int}


def _missing(content: dict[str, Any]) -> str | None:
    """The first entry that is not what it must be."""
    kinds: dict[str, type] = {"config": dict, "choices": dict, "step": int}
    for name, kind in kinds.items():
        if not isinstance(content[name], kind):
            return name
    inside = _inside(content) if content["format"] > 1 else {"weights": content["weights"]}
    for name, wanted in _OF_INFERENCE.items() if content["format"] > 1 else ():
        if name not in inside or not isinstance(inside[name], wanted):
            return f"inference.{name}"
    return None if isinstance(inside["weights"], dict) else "weights"


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

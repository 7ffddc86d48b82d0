"""What a configuration may hold: keys, types and bounds."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from apex_lab.base.validation import PathText
from apex_lab.config import initial
from apex_lab.config.components import is_node


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class TrainerPart(_Part):
    """Length and device of training; `steps` are weight updates.

    A key that was added later has the default that stands in `apex_lab.config.upgrades.ADDED` too.
    """

    accelerator: Literal["auto", "cpu", "gpu"]
    devices: int = Field(default=1, ge=1)
    num_nodes: int = Field(default=1, ge=1)
    precision: Literal[32, "bf16-mixed"]
    compile: bool
    cuda_graph: bool = False
    matmul_precision: Literal["highest", "high", "medium"] = "highest"
    max_steps: int = Field(ge=1)
    max_minutes: float | None = Field(default=None, gt=0)
    gradient_clip_norm: float | None = Field(gt=0)
    log_interval: int = Field(ge=1)
    validation_interval: int | None = Field(ge=1)
    validation_videos: int | None = Field(ge=1)
    checkpoint_interval: int = Field(ge=1)
    monitor: str = Field(pattern="^val/.+")
    monitor_mode: Literal["max", "min"]


class ClipsPart(_Part):
    """What a training step sees.

    Attributes:
        batch_size: clips of the global batch.
        frames: of a clip: null for whole videos, a number, or a schedule.
        starts: of clips that are shorter than their videos: `random`, or `disjoint`, pieces one after the other.
        on_device: share of a GPU's free memory that the training videos may take; in it they are kept there.
    """

    batch_size: int = Field(ge=1)
    frames: int | dict[str, Any] | None = None
    starts: Literal["random", "disjoint"] = "random"
    on_device: float = Field(default=0.25, ge=0, le=1)


class EvaluationPart(_Part):
    """What is measured and drawn at the end of training; `videos` null means the whole split."""

    split: Literal["train", "val", "test"]
    videos: int | None = Field(ge=1)
    pictures: int = Field(ge=0)
    batch_size: int = Field(default=4, ge=1)
    chunk: int | None = Field(default=None, ge=1)


class PathsPart(_Part):
    """Folders; relative ones are taken from where the command was started."""

    outputs: PathText
    data: PathText


class InitialPart(_Part):
    """Weights that training starts from; `apex_lab.config.initial` puts them in place of the word that was given."""

    checkpoint: str
    weights: str = Field(pattern=f"^{initial.DIGEST}$")


def _node(value: Any) -> Any:
    if not isinstance(value, dict):
        raise ValueError("a schedule has keys: set those, or give another one with a _target_")
    return value


class Config(_Part):
    """The root of what `python -m apex_lab.train` composes; components are checked by `apex_lab.config.components`."""

    seed: int = Field(ge=0, lt=2**32)
    init_from: InitialPart | None = None
    model: dict[str, Any]
    optimizer: dict[str, Any] | None
    schedule: dict[str, Annotated[dict[str, Any], BeforeValidator(_node)]]
    loss: dict[str, float | dict[str, Any]]
    lr_scale: float | dict[str, Any]
    data: dict[str, Any]
    clips: ClipsPart
    trainer: TrainerPart
    logger: dict[str, dict[str, Any]]
    callbacks: dict[str, dict[str, Any]]
    evaluation: EvaluationPart
    paths: PathsPart

    @model_validator(mode="after")
    def _components_named(self) -> Config:
        named: dict[str, Any] = {"model": self.model, "data": self.data}
        for group in ("schedule", "logger", "callbacks"):
            named.update({f"{group}.{name}": node for name, node in getattr(self, group).items()})
        if self.optimizer is not None:
            named["optimizer"] = self.optimizer
        for key, node in named.items():
            if not is_node(node):
                raise ValueError(f"{key} has no _target_: choose one of the shipped files or name the class to build")
        return self

"""Settings that determine the bytes of a data set of clips."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sims.arrangement.settings import Names, Span
from sims.arrangement.settings import Settings as Task
from sims.camera import Camera

_TASK = Task()


class Settings(BaseModel):
    """Settings of the clips; two sets with equal settings (and versions) have equal bytes. The paper states none."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    seed: int = Field(default=0, ge=0)
    train: int = Field(default=2000, ge=0)
    val: int = Field(default=200, ge=0)
    test: int = Field(default=200, ge=0)
    frames: int = Field(default=20, ge=1)
    image_size: int = Field(default=128, ge=16, le=1024)
    render_size: int = Field(default=_TASK.image_size, ge=64, le=1024)
    """Images are rendered at this size, that of the task, and scaled down as the task's images are for a model."""
    min_objects: int = Field(default=2, ge=1)
    max_objects: int = Field(default=4, ge=1)
    moving: float = Field(default=0.5, ge=0, le=1)
    """Share of the objects that slide over the table; in every clip one does, unless it is 0."""
    step_m: float = Field(default=0.025, gt=0, le=0.1)
    """Greatest distance that an object slides between two frames."""
    renderer: Literal["tiny", "egl"] = "tiny"
    camera: Camera = _TASK.camera
    objects: Names = _TASK.objects
    """Classes to draw from, without repetition within a clip."""
    workspace_x: Span = _TASK.workspace_x
    workspace_y: Span = _TASK.workspace_y

    @model_validator(mode="after")
    def _check(self) -> Settings:
        if self.min_objects > self.max_objects:
            raise ValueError(f"min_objects {self.min_objects} must not exceed max_objects {self.max_objects}")
        if len(self.objects) < self.max_objects:
            raise ValueError(
                f"max_objects {self.max_objects} needs as many classes in objects, which has {len(self.objects)}"
            )
        if self.image_size > self.render_size:
            raise ValueError(f"image_size {self.image_size} must not exceed render_size {self.render_size}")
        _ = self.task  # what the task would refuse
        return self

    @property
    def task(self) -> Task:
        """Those of the task that an image depends on."""
        return Task(
            image_size=self.render_size,
            renderer=self.renderer,
            camera=self.camera,
            objects=self.objects,
            workspace_x=self.workspace_x,
            workspace_y=self.workspace_y,
        )

"""Settings that determine the bytes of a P2D data set."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sims.camera import Camera
from sims.objects import CATALOGUE

Span = Annotated[tuple[float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]


CROWDED = 4
"""From this many objects on, places are drawn many at once, the largest objects first: one by one, nearly all tries
fail for lack of room. Trajectories of fewer keep the draws on which the bytes of data sets depend."""


class Settings(BaseModel):
    """Settings of a P2D data set; two sets with equal settings (and versions) have equal bytes.

    The defaults are the paper's (apex_paper.tex, section Datasets) where it states them, else sims.md.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    seed: int = Field(default=0, ge=0)
    train: int = Field(default=2000, ge=0)
    val: int = Field(default=200, ge=0)
    test: int = Field(default=200, ge=0)
    frames: int = Field(default=20, ge=1)
    """Frames per trajectory, spread evenly over the whole push, its first and last moment included."""
    image_size: int = Field(default=128, ge=16, le=1024)
    min_objects: int = Field(default=1, ge=1, le=14)
    max_objects: int = Field(default=3, ge=1, le=14)
    aim: float = Field(default=0.5, ge=0, le=1)
    """Share of lines sampled to meet an object."""
    renderer: Literal["tiny", "egl"] = "tiny"
    """'tiny' renders on the CPU, 'egl' on a GPU; their images differ."""
    camera: Camera = Camera()
    objects: Names = tuple(entry.name for entry in CATALOGUE)
    """Classes to sample from, without repetition within a trajectory."""
    objects_root: str | None = None
    """Folder of textured models, one sub-folder per object with an OBJ and its PNG; None: procedural textures."""
    workspace_x: Span = (0.39, 0.65)
    """Workspace of objects and lines: metres in front of the robot's base."""
    workspace_y: Span = (-0.17, 0.12)
    """Metres to the left of the robot's base."""
    height_m: float = Field(default=0.012, ge=0.01, le=0.2)
    """Height above the table of the point between the fingertips, whose lower ends are 7 mm below it."""
    speed_m_s: float = Field(default=0.15, gt=0, le=0.5)
    """Speed of the gripper along its line."""
    max_redraws: int = Field(default=100, ge=0)
    """Rejected attempts at one trajectory before it is an error."""

    @model_validator(mode="after")
    def _check(self) -> Settings:
        if self.min_objects > self.max_objects:
            raise ValueError(f"min_objects {self.min_objects} must not exceed max_objects {self.max_objects}")
        if len(set(self.objects)) != len(self.objects):
            raise ValueError(f"objects {list(self.objects)} names a class twice")
        if len(self.objects) < self.max_objects:
            raise ValueError(
                f"max_objects {self.max_objects} needs as many classes in objects, which has {len(self.objects)}"
            )
        for key in ("workspace_x", "workspace_y"):
            low, high = getattr(self, key)
            if high - low < 0.1:
                raise ValueError(f"{key} {(low, high)} must span at least 0.1 m, from low to high")
        return self

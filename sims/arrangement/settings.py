"""Settings of the arrangement task: what, with the seed, determines its scenarios and the controller's motions."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sims.camera import Camera

Span = Annotated[tuple[float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]

RESTS = {
    "potted_meat_can": "upright",
    "sugar_box": "on_side",
    "tomato_soup_can": "upright",
    "foam_brick": "upright",
    "pudding_box": "on_back",
    "banana": "upright",
}
"""The graspable classes, each in the orientation in which it lies: narrower than 75 mm between the fingers, lower than
the 11 cm up to which the hand passes above its neighbours, and stable."""
MAX_OBJECTS = 4


class Settings(BaseModel):
    """Settings of the task. The paper states the numbers of objects and of scenarios; all else is decided here."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    image_size: int = Field(default=128, ge=64, le=1024)
    renderer: Literal["tiny", "egl"] = "tiny"
    """'tiny' renders on the CPU, 'egl' on a GPU; their images differ."""
    camera: Camera = Camera(eye=(0.48, -0.66, 0.84), target=(0.48, -0.01, 0.03), fov_deg=31.0)
    depth: Literal["exact", "stereo"] = "exact"
    """'stereo' adds a stereo camera's noise and holes (`sensor.stereo`)."""
    objects: Names = ("potted_meat_can", "sugar_box", "tomato_soup_can", "foam_brick")
    """The first n are the group of the task with n objects."""
    workspace_x: Span = (0.35, 0.61)
    """Centres of the objects in both scenes: metres in front of the robot's base."""
    workspace_y: Span = (-0.2, 0.2)
    """Metres to the left of the robot's base."""
    edge_m: float = Field(default=0.06, ge=0.0, le=0.2)
    """Width of the edge around the workspace, where objects are put aside."""
    moved_m: float = Field(default=0.08, ge=0.0, le=0.3)
    """Minimum distance between an object's place in the current scene and its goal."""
    max_attempts: int = Field(default=3, ge=1, le=10)
    """Attempts at bringing one object to its goal."""
    time_limit_s: float = Field(default=60.0, gt=0)
    """Simulated seconds per object of the scenario, after which no further sub-task is started."""
    planning_limit: int = Field(default=10_000, ge=1)
    """Comparisons of the planner (`planner.Planner`) per object of the scenario, after which no further sub-task is
    planned. The oracle needs up to 1,500; dozens of false detections would need very many."""
    reached_m: float = Field(default=0.02, gt=0, le=0.1)
    """An object seen this near its goal is not moved again."""
    failed_m: float = Field(default=0.05, gt=0, le=0.5)
    """An object that ends farther than this from its goal gets a reason of failure."""
    video_fps: int = Field(default=10, ge=1, le=60)

    @model_validator(mode="after")
    def _check(self) -> Settings:
        unknown = [name for name in self.objects if name not in RESTS]
        if unknown:
            raise ValueError(f"objects names {unknown[0]!r}, which the gripper cannot grasp: choose from {list(RESTS)}")
        if len(set(self.objects)) != len(self.objects):
            raise ValueError(f"objects {list(self.objects)} names a class twice")
        if not 1 <= len(self.objects) <= MAX_OBJECTS + 2:
            raise ValueError(f"objects must name 1 to {MAX_OBJECTS + 2} classes, not {len(self.objects)}")
        for key in ("workspace_x", "workspace_y"):
            low, high = getattr(self, key)
            if high - low < 0.1:
                raise ValueError(f"{key} {(low, high)} must span at least 0.1 m, from low to high")
        return self

"""How an evaluation scores, as keys of the configuration; the defaults are those of the paper's tables."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from apex_lab.metrics import EvaluatorSettings, TrackingSettings
from apex_lab.metrics.boundary import TOLERANCE

OF_SCENES = ("min_presence", "presence_after", "masks", "resize")
"""Keys of the way from a `Scene` to identities; files of predictions hold identities."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class TrackingPart(_Part):
    """The fields of `apex_lab.metrics.TrackingSettings`."""

    first_frame: int = 0
    stop_frame: int | None = None
    min_iou: float = 0.5
    min_pixels: int = 5
    background_iou: float | None = 0.2
    tracked_share: float = 0.8
    drop_background_slot: bool = False

    @model_validator(mode="after")
    def _possible(self) -> TrackingPart:
        TrackingSettings(**self.model_dump())
        return self


class ScoringPart(_Part):
    """How videos are scored.

    Attributes:
        tracking, public_first_frame, first_frame, skip_empty, boundary_tolerance, ignore_label: as in
            `apex_lab.metrics.EvaluatorSettings`.
        identities: `own`, `none` and `linked` as there; `auto` is `own` for a model that tracks (`SceneModel.tracks`)
            and for files of predictions, else `none`.
        min_presence, presence_after: as in `apex_lab.metrics.scene_identities`.
        masks: `model` scores `Scene.masks`, as the paper does; `posterior` scores `SceneModel.posterior`.
        resize: of models with an input size of their own: `masks` brings soft masks to the size of the truth before the
            argmax; `truth` brings the truth to the size of the masks, by nearest neighbour.
    """

    tracking: TrackingPart = TrackingPart()
    public_first_frame: int | None = 2
    first_frame: int = Field(default=0, ge=0)
    skip_empty: bool = False
    boundary_tolerance: float = TOLERANCE
    ignore_label: int | None = None
    identities: Literal["auto", "own", "none", "linked"] = "auto"
    min_presence: float = Field(default=0.5, ge=0, le=1)
    presence_after: bool = False
    masks: Literal["model", "posterior"] = "model"
    resize: Literal["masks", "truth"] = "masks"

    @model_validator(mode="after")
    def _possible(self) -> ScoringPart:
        self.settings(True)
        return self

    def settings(self, tracks: bool, details: bool = False) -> EvaluatorSettings:
        """Settings of the evaluator.

        Args:
            tracks: whether identities hold over time.
            details: keep rows per frame and events.
        """
        return EvaluatorSettings(
            tracking=TrackingSettings(**self.tracking.model_dump()),
            public_first_frame=self.public_first_frame,
            first_frame=self.first_frame,
            skip_empty=self.skip_empty,
            boundary_tolerance=self.boundary_tolerance,
            ignore_label=self.ignore_label,
            identities=("own" if tracks else "none") if self.identities == "auto" else self.identities,
            per_frame=details,
            events=details,
        )

    def stored(self, tracks: bool) -> dict[str, Any]:
        """The settings stored with the results."""
        of_scenes = {name: getattr(self, name) for name in OF_SCENES}
        return {**asdict(self.settings(tracks)), **of_scenes}

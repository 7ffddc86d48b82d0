"""Everything that decides the bytes of a P2D data set."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


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
    image_size: int = Field(default=128, ge=16, le=1024)
    min_objects: int = Field(default=1, ge=1, le=14)
    max_objects: int = Field(default=3, ge=1, le=14)
    aim: float = Field(default=0.5, ge=0, le=1)
    """Share of lines drawn so that they meet an object."""

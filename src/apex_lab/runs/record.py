"""What run.json holds, and the one reader of it. Imports no PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.validation import LARGEST, validate

ADVICE = "run the same command again, which sets it aside"
"""What to do about a damaged record."""


class Start(BaseModel):
    """One start of a run, an entry of its history."""

    model_config = ConfigDict(extra="ignore", strict=True)

    started: str


class Continued(BaseModel):
    """The shorter run that a run began with, and at which step."""

    model_config = ConfigDict(extra="ignore", strict=True)

    folder: str
    step: int = Field(ge=0, lt=LARGEST)


class Kept(BaseModel):
    """What a checkpoint keeps of a record, in case that the file is lost."""

    model_config = ConfigDict(extra="ignore", strict=True)

    continues: Continued | None = None
    history: list[Start] = []
    foreground_share: float | None = None
    wandb_id: str | None = None


class Record(Kept):
    """The entries that are read again, by whatever command; others may stand beside them."""

    format: int = Field(default=1, ge=1, lt=LARGEST)
    status: str | None = None
    outcome: str | None = None
    reason: str | None = None
    host: str | None = None
    pid: int | None = Field(default=None, ge=0, lt=2**31)
    heartbeat: str | None = None
    started: str | None = None
    seed: int | None = None
    seconds: float = Field(default=0.0, ge=0.0, lt=1e12)
    steps: int = Field(default=0, ge=0, lt=LARGEST)
    max_steps: int | None = Field(default=None, ge=0, lt=LARGEST)
    overrides: list[str] = []
    fingerprint: str | None = None
    data_fingerprint: str | None = None


def read_record(file: Path) -> dict[str, Any]:
    """Content of a run.json.

    Raises:
        UserError: it is missing or damaged, or an entry is not what it must be.
    """
    content = read_json(file, ADVICE)
    check(Record, content, file)
    return content


def check(schema: type[Kept], content: Mapping[str, Any], file: Path) -> None:
    """Compares entries with what they must be.

    Args:
        schema: of them.
        content: the entries.
        file: where they come from.

    Raises:
        UserError: one is of another kind.
    """
    try:
        schema.model_validate(content)
    except ValidationError:
        try:
            validate(schema, content, "")
        except UserError as error:
            raise UserError(f"{file} is damaged: {error}") from error
        raise UserError(f"{file} is damaged: {ADVICE}.") from None

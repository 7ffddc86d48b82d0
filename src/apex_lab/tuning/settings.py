"""The keys of a study: conf/tune.yaml, below `study`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from apex_lab.base.errors import UserError
from apex_lab.base.validation import did_you_mean, sentence, validate
from apex_lab.config import components
from apex_lab.config.schema import PathsPart
from apex_lab.metrics.keys import VALIDATION_SCORES

ELBO = "elbo"
"""The objective that needs no labels: minus the sum of the loss terms `nll` and `kl_*`, in nats per video."""

OBJECTIVES = (*VALIDATION_SCORES, ELBO)
"""What can be maximised; of validation videos."""


class StudyPart(BaseModel):
    """One study; what each key means: conf/tune.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    name: str | None = Field(default=None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    trials: int = Field(ge=1)
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**32)], ...] = Field(min_length=1)
    objectives: tuple[str, ...] | None = Field(min_length=1)
    unsupervised: bool
    overrides: tuple[str, ...]
    recipe_first: bool
    storage: str | None = Field(min_length=1)
    heartbeat_seconds: int = Field(ge=1)
    retries: int = Field(ge=0)
    max_minutes: float | None = Field(gt=0)
    conf: str | None = Field(min_length=1)
    seed: int = Field(ge=0, lt=2**32)
    sampler: dict[str, Any]
    pruner: dict[str, Any]

    @field_validator("seeds", "objectives")
    @classmethod
    def _once(cls, values: tuple[Any, ...] | None) -> tuple[Any, ...] | None:
        if values is not None and len(set(values)) < len(values):
            raise ValueError("name each once")
        return values

    @property
    def scores(self) -> tuple[str, ...]:
        """The objectives, all to be maximised."""
        if self.objectives is not None:
            return self.objectives
        return (ELBO,) if self.unsupervised else ("ari_fg",)


class TuneConfig(BaseModel):
    """The root of what `python -m apex_lab.tune` composes for itself."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    study: StudyPart
    paths: PathsPart


def check_settings(raw: Mapping[str, Any]) -> TuneConfig:
    """Checks the study's own keys.

    Raises:
        UserError: unknown key, impossible value, or a combination that means nothing; one sentence.
    """
    asked = validate(TuneConfig, {key: value for key, value in raw.items() if key != "hydra"}, "")
    assert isinstance(asked, TuneConfig)
    study = asked.study
    for name in study.scores:
        if name not in OBJECTIVES:
            guess = did_you_mean(name, OBJECTIVES)
            raise UserError(sentence(f"study.objectives: '{name}' is none of {', '.join(OBJECTIVES)}{guess}"))
    if study.unsupervised and any(name != ELBO for name in study.scores):
        raise UserError(
            f"study.unsupervised = true goes without labels, and study.objectives = [{','.join(study.scores)}] needs "
            "them: leave one of the two out."
        )
    for key in ("sampler", "pruner"):
        node = getattr(study, key)
        if not components.is_node(node):
            raise UserError(f"study.{key} has no _target_: choose one of the shipped files with study/{key}=...")
    components.check(study.sampler, "study.sampler", supplied=["seed"])
    components.check(study.pruner, "study.pruner")
    return asked

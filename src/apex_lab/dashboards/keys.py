"""Which values the runs of a job log to Weights & Biases, by topic.

The configuration tells all names but those of diagnostics, which a model returns. They are in `DIAGNOSTICS` for the
models here, so that a dashboard can be made before its runs start or where they lie on other machines; those of other
models are in curves.csv once a run has begun.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

from apex_lab.metrics.keys import VALIDATION_SCORES
from apex_lab.runs.listed import Listed

TRACKING_SCORES = ("mota", "match")
"""Scores of validation that need identities over time."""

DIAGNOSTICS = {
    "apex": (
        "live_objects",
        "foreground",
        "window_size",
        "discovery_prob",
        "propagated_prob",
        "propagated_share",
    ),
    "gswm": ("live_objects", "presence", "foreground", "window_size", "tracked_share"),
    "op3": ("nll_predicted", "nll_refined"),
    "scalor": (
        "live_objects",
        "foreground",
        "window_size",
        "presence",
        "discovered",
        "rejected_share",
        "stayed_share",
    ),
    "slot_attention": ("slots_in_use",),
    "space": ("live_objects", "foreground", "window_size"),
}
"""Model -> its diagnostics whose names do not depend on its size."""

OBJECTS = ("live_objects", "slots_in_use", "foreground", "window_size")
"""Diagnostics of how many objects there are, and how large."""

PRESENCE = (
    "presence",
    "discovery_prob",
    "discovered",
    "rejected_share",
    "propagated_prob",
    "propagated_share",
    "stayed_share",
    "tracked_share",
)
"""Diagnostics of when objects appear, stay and go."""


class Topics(NamedTuple):
    """Names of logged values.

    Attributes:
        scores: on validation videos.
        losses: whole loss in training and validation, norm of the gradient.
        terms: of the loss, on validation videos.
        objects: how many objects, how large.
        presence: when they appear, stay and go.
        diagnostics: all other ones.
        rates: learning rate and speed.
        schedules: scheduled values.
        final: scores of the evaluation after training; in the summary of a run.
        strips, movies, tables: pictures, and tables with a row per video.
    """

    scores: list[str]
    losses: list[str]
    terms: list[str]
    objects: list[str]
    presence: list[str]
    diagnostics: list[str]
    rates: list[str]
    schedules: list[str]
    final: list[str]
    strips: list[str]
    movies: list[str]
    tables: list[str]


def topics(jobs: Sequence[Listed], tracking: Collection[str]) -> Topics:
    """What any of the jobs logs, in the order of the jobs and without repetition.

    Args:
        jobs: at least one.
        tracking: models that keep identities over time.
    """
    found: dict[str, None] = {}
    seen: set[str] = set()
    for job in jobs:
        if job.name not in seen:
            seen.add(job.name)
            found.update(dict.fromkeys(_of_configuration(job, job.choices.get("model", "") in tracking)))
    for job in _one_with_curves(jobs):
        found.update(dict.fromkeys(columns(job)))

    def among(*names: str) -> list[str]:
        return [name for name in names if name in found]

    named = {f"diagnostics/{name}" for name in (*OBJECTS, *PRESENCE)}
    shown = [job for job in jobs if job.raw["evaluation"]["pictures"]]
    tracks = any(job.choices.get("model", "") in tracking for job in jobs)
    splits = list(dict.fromkeys(str(job.raw["evaluation"]["split"]) for job in jobs))
    drawn = list(dict.fromkeys(str(job.raw["evaluation"]["split"]) for job in shown))
    final = [name for name in VALIDATION_SCORES if tracks or name not in TRACKING_SCORES]
    return Topics(
        scores=among(*(f"val/{name}" for name in VALIDATION_SCORES)),
        losses=among("train/loss", "val/loss", "train/gradient_norm"),
        terms=[name for name in found if _is_term(name)],
        objects=among(*(f"diagnostics/{name}" for name in OBJECTS), "val/foreground_share"),
        presence=among(*(f"diagnostics/{name}" for name in PRESENCE)),
        diagnostics=[name for name in found if name.startswith("diagnostics/") and name not in named],
        rates=among("schedule/lr", "train/frames_per_second"),
        schedules=[name for name in found if name.startswith("schedule/") and name != "schedule/lr"],
        final=[f"{split}/{name}" for split in splits for name in final],
        strips=[f"{split}/film_strip" for split in drawn],
        movies=[f"{split}/movie" for split in drawn],
        tables=[f"{split}/per_video" for split in splits],
    )


def columns(job: Listed) -> list[str]:
    """Names of the values in a run's curves.csv; none where it has no such file."""
    try:
        with open(job.folder / "curves.csv", newline="", encoding="utf-8", errors="replace") as file:
            return [name for name in next(csv.reader(file), []) if name != "step"]
    except (OSError, csv.Error):
        return []


def _one_with_curves(jobs: Sequence[Listed]) -> Iterator[Listed]:
    """The run of each configuration that has come furthest; a later validation adds columns."""
    furthest: dict[str, Listed] = {}
    for job in jobs:
        if job.state.state != "waiting" and (
            job.name not in furthest or job.state.steps > furthest[job.name].state.steps
        ):
            furthest[job.name] = job
    yield from furthest.values()


def _of_configuration(job: Listed, tracks: bool) -> Iterator[str]:
    """What a run of this configuration will log; nothing for a model that is not trained."""
    if job.raw.get("optimizer") is None:
        return
    yield from (f"val/{name}" for name in VALIDATION_SCORES if tracks or name not in TRACKING_SCORES)
    yield from ("train/loss", "val/loss", "train/gradient_norm", "schedule/lr", "train/frames_per_second")
    yield from (f"val/{term}" for term in job.raw["loss"])
    yield from (f"schedule/{name}" for name in job.raw["schedule"])
    yield from (f"diagnostics/{name}" for name in DIAGNOSTICS.get(job.choices.get("model", ""), ()))


def _is_term(name: str) -> bool:
    """Whether a name is that of a term of the loss on validation videos."""
    group, _, value = name.partition("/")
    return group == "val" and value not in (*VALIDATION_SCORES, "loss", "foreground_share")

"""Hand-made run folders with known numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from apex_lab.tables import definition as spec
from apex_lab.tables.asked import Tables, TablesConfig, assemble
from apex_lab.tables.build import Built
from apex_lab.tables.choose import Version
from apex_lab.tables.found import collect
from apex_lab.tables.missing_runs import Command
from apex_lab.tables.rows import Line

SEGMENTATION = {"ari_fg": 0.5, "msc_fg": 0.4, "ari": 0.6, "msc": 0.7}
TRACKING = {
    "mota": 40.0,
    "motp": 80.0,
    "match": 60.0,
    "id_switches": 1.0,
    "fps": 20.0,
    "misses": 39.0,
    "md": 50.0,
    "mt": 45.0,
}
SCORES = SEGMENTATION | TRACKING | {f"{key}_start2": value for key, value in TRACKING.items()}
DATA = "d" * 32
SPECIFICATION = spec.load()


def run_folder(
    outputs: Path,
    model: str,
    seed: int,
    scores: dict[str, Any] | None = None,
    *,
    hash8: str = "0123abcd",
    metrics: dict[str, Any] | None = None,
    videos: int = 200,
    **record: Any,
) -> Path:
    """Writes run.json and, for a finished run, metrics.json; `scores` and `record` change single entries."""
    about = {
        "status": "finished",
        "reason": None,
        "started": f"2026-01-01T00:00:{seed:02d}+00:00",
        "overrides": [f"model={model}", f"seed={seed}"],
        "model": model,
        "ablation": None,
        "data": "p2d",
        "scale": "paper",
        "experiment": None,
        "seed": seed,
        "fingerprint": hash8 * 8,
        "data_fingerprint": DATA,
        **record,
    }
    words = [about[group] for group in ("model", "ablation", "data", "scale") if about[group]]
    folder = outputs / "_".join([*words, hash8]) / f"seed_{seed}"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(about))
    if about["status"] == "finished":
        total = {key: value for key, value in {**SCORES, **(scores or {})}.items() if value != "absent"}
        split = {"videos": videos, "frames": 20 * videos, "total": {"videos": videos, **total}, "per_video": []}
        content = {"settings": {"scoring": {"first_frame": 0}}, "versions": {}, "splits": {"test": split}}
        (folder / "metrics.json").write_text(json.dumps({**content, **(metrics or {})}))
    return folder


VERSION = Version(
    models={"apex", "oracle", "one_segment", "color_clusters", "background_subtraction"},
    ablations={"image_stn", "no_entropy", "scalor_norm", "gaussian", "gaussian_scalor_norm"},
    fingerprint=lambda words: "0123abcd" * 8,
)
"""A version whose configurations all have the fingerprint that `run_folder` writes."""


def job(outputs: Path, **asked: Any) -> Tables:
    """A checked command on p2d at paper scale; `asked` changes single keys."""
    keys: dict[str, Any] = {
        "tables": (1,),
        "seeds": (0, 1, 2, 3),
        "exclude_failed": ("gswm",),
        "groups": (),
        "published": False,
        "yardsticks": False,
        "arrangement_mean": "scenario",
        "folder": None,
        "dry_run": True,
        "paths": {"outputs": str(outputs), "data": "data"},
    }
    return Tables(TablesConfig(**keys | asked), "p2d", "paper", SPECIFICATION, ())


def made(
    outputs: Path, version: Version = VERSION, scale: str = "paper", **asked: Any
) -> tuple[list[Built], list[Command], list[str]]:
    """Tables, commands and problems of a folder of runs."""
    return assemble(collect(outputs), replace(job(outputs, **asked), scale=scale), version)


def line(table: Built, label: str) -> Line:
    """The row of that name."""
    return next(line for line in table.lines if line.label == label)

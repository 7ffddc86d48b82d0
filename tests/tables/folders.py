"""Hand-made run folders with known numbers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from apex_lab.config.upgrades import fingerprint
from apex_lab.runs.listed import Listed
from apex_lab.runs.state import read_state
from apex_lab.tables import definition as spec
from apex_lab.tables.asked import Tables, TablesConfig, assemble
from apex_lab.tables.build import Built
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


def job(outputs: Path, model: str, seed: int, ablation: str | None = None, **more: Any) -> Listed:
    """A job whose run is where `run_folder` puts it; `more`: data, scale, hash8, words."""
    data, scale = more.get("data", "p2d"), more.get("scale", "paper")
    extra = more.get("words", ())
    choices = {"model": model, "data": data, "scale": scale, **({"ablation": ablation} if ablation else {})}
    words = [f"model={model}", *([f"+ablation={ablation}"] if ablation else []), f"seed={seed}"]
    words += [*([f"data={data}"] if data != "p2d" else []), f"scale={scale}", *extra]
    raw = {"seed": seed, "paths": {"outputs": str(outputs)}, "model": {"values": list(extra)}}
    named = [model, *([ablation] if ablation else []), data, scale, more.get("hash8", "0123abcd")]
    return Listed(tuple(words), raw, choices, fingerprint(raw), read_state(outputs / "_".join(named) / f"seed_{seed}"))


YARDSTICKS = {row.model for section in SPECIFICATION.yardsticks for row in section.rows}


def jobs(outputs: Path, tables: Sequence[int], seeds: Sequence[int], **more: Any) -> list[Listed]:
    """The jobs of the rows of tables, as the shipped sweeps have them."""
    wanted = [table for table in SPECIFICATION.tables if table.number in tables]
    sections = [section for table in wanted for section in SPECIFICATION.sections(table, yardsticks=True)]
    rows = dict.fromkeys(row.run for section in sections for row in section.rows)
    return [
        job(outputs, model, seed, ablation, **more)
        for model, ablation in rows
        for seed in ((0,) if model in YARDSTICKS else seeds)
    ]


def asked(outputs: Path, **keys: Any) -> Tables:
    """A checked command; `keys` changes single ones of its own, `seeds`, `scale`, `data` and `jobs` what is run."""
    own: dict[str, Any] = {
        "tables": (1,),
        "exclude_failed": ("gswm",),
        "published": False,
        "yardsticks": False,
        "arrangement_mean": "scenario",
        "folder": None,
        "dry_run": True,
    }
    settings = TablesConfig(**{**own, **{key: value for key, value in keys.items() if key in own}})
    more = {key: value for key, value in keys.items() if key in ("data", "scale")}
    listed = keys.get("jobs") or jobs(outputs, settings.tables or (1,), keys.get("seeds", (0, 1, 2, 3)), **more)
    return Tables(settings, ("+sweep=some",), tuple(listed), settings.tables, SPECIFICATION)


def made(outputs: Path, **keys: Any) -> tuple[tuple[Built, ...], tuple[Command, ...]]:
    """Tables and commands of a folder of runs."""
    found = assemble(asked(outputs, **keys))
    return found.tables, found.commands


def line(table: Built, label: str) -> Line:
    """The row of that name."""
    return next(line for line in table.lines if line.name == label)

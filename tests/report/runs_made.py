"""Run folders without training: what runs leave behind, for tests of a report."""

from __future__ import annotations

import csv
import json
import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from apex_lab.config.upgrades import FORMAT
from apex_lab.report.pictures import MOVIE, STRIP
from apex_lab.runs.listed import Listed

SCORES = {"ari_fg": 0.8, "msc_fg": 0.7, "ari": 0.9, "msc": 0.75}
SCORES |= {
    "mota": 50.0,
    "motp": 80.0,
    "match": 75.0,
    "id_switches": 1.0,
    "fps": 30.0,
    "misses": 20.0,
    "md": 70.0,
    "mt": 71.0,
}


def made(job: Listed, status: str = "finished", reason: str | None = None, **more: Any) -> None:
    """Writes the folder of a job's run.

    Args:
        job: whose.
        status: of its record.
        reason: why it ended early.
        more: further entries of the record.
    """
    draw = random.Random(f"{job.name}{job.seed}")
    folder, steps = job.folder, 200
    folder.mkdir(parents=True)
    _json(
        folder / "run.json",
        {
            "format": FORMAT,
            "status": status,
            "outcome": status,
            "reason": reason,
            "seconds": 1800.0,
            "steps": steps,
            "max_steps": steps,
            "overrides": list(job.words),
            **{group: job.choices.get(group) for group in ("model", "ablation", "data", "scale", "experiment")},
            "seed": job.seed,
            "fingerprint": job.fingerprint,
            "data_fingerprint": "d1d2d3d4",
            "commit": "c0ffee",
            "dirty": False,
            "versions": {"python": "3.11.7", "torch": "2.13.0"},
            "hardware": {"cpu": "A processor", "device": "cpu"},
            "foreground_share": 0.1,
            **more,
        },
    )
    curves(folder / "curves.csv", range(10, steps + 1, 10), draw)
    if status == "finished":
        total = {key: value * draw.uniform(0.9, 1.1) for key, value in SCORES.items()}
        total |= {f"{key}_start2": total[key] for key in SCORES if key not in ("ari_fg", "msc_fg", "ari", "msc")}
        split = {"videos": 20, "frames": 100, "data_fingerprint": "d1d2d3d4", "settings": {}, "total": total}
        _json(folder / "metrics.json", {"splits": {"test": split}})


def _json(file: Path, content: object) -> None:
    file.write_text(json.dumps(content))


def curves(file: Path, steps: Sequence[int], draw: random.Random) -> None:
    """A table of curves that rise and fall as in training."""
    with open(file, "w", newline="") as opened:
        rows = csv.writer(opened)
        rows.writerow(["step", "train/loss", "diagnostics/live_objects", "val/ari_fg", "val/msc_fg"])
        for step in steps:
            done = 1 - math.exp(-step / 60)
            scores = [done * draw.uniform(0.7, 0.8), done * draw.uniform(0.6, 0.7)] if step % 20 == 0 else ["", ""]
            rows.writerow([step, -5e4 * done + draw.gauss(0, 500), 4 * done + draw.random(), *scores])


def pictures(folder: Path) -> None:
    """A film strip and a movie of noise in a run folder."""
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 128, 3), np.uint8)
    (folder / "view").mkdir()
    iio.imwrite(folder / STRIP, noise[0])
    iio.imwrite(folder / MOVIE, noise, fps=5, macro_block_size=16)

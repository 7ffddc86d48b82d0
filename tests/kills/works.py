"""The commands that the suite kills, at their smallest, and what of each must be as if nothing had happened."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image

from tests.conftest import REPOSITORY, TINY
from tests.fakes.p2d_tools import content
from tests.kills.processes import Results

STAYING = (".multirun",)
"""Hidden folders that stay: Hydra's own."""

SMALL_P2D = ("--set", "train=4", "val=1", "test=1", "frames=3", "image_size=32", "--workers", "2", "--no-card")
CLIPS = json.dumps({"train": 3, "val": 1, "test": 1, "frames": 2, "image_size": 16, "render_size": 64})
MODELS = ("apex", "gswm", "op3", "scalor", "slot_attention", "space")
STEPS = ("trainer.max_steps=12", "trainer.checkpoint_interval=3", "trainer.validation_interval=6")
SQUARES = ("--config-dir", str(REPOSITORY / "tests" / "conf"), "data=squares", "scale=smoke", "evaluation.pictures=0")


@dataclass(frozen=True)
class Work:
    """A command.

    Attributes:
        entry: its module.
        words: its arguments; "{inputs}" stands for the folder with what it reads.
        results: what must be equal in the end.
        workers: it has processes of its own, so it may be killed without them.
        variables: of its environment.
    """

    entry: str
    words: tuple[str, ...]
    results: Results
    workers: bool = False
    variables: dict[str, str] = field(default_factory=dict)


def runs(folder: Path) -> dict[str, Any]:
    """Of every run: weights, best step, scores and curves, without what depends on the clock."""
    found: dict[str, Any] = {}
    for run in sorted(folder.rglob("seed_*")):
        if not (run / "run.json").is_file():
            continue
        name = run.relative_to(folder)
        record = json.loads((run / "run.json").read_text())
        found[f"{name}: state"] = (record["status"], record["steps"])
        for file in ("last", "best"):
            path = run / "checkpoints" / f"{file}.ckpt"
            stored = torch.load(path, weights_only=True) if path.is_file() else None
            found[f"{name}: {file}"] = stored and (stored["step"], _digest(stored["inference"]["weights"]))
        splits = json.loads((run / "metrics.json").read_text())["splits"]
        for split in splits.values():
            split["data"].pop("folder", None)
        found[f"{name}: scores"] = splits
        if (run / "curves.csv").is_file():
            with open(run / "curves.csv", newline="") as file:
                rows = list(csv.DictReader(file))
            found[f"{name}: curves"] = [{k: v for k, v in row.items() if "per_second" not in k} for row in rows]
    return found


def _digest(weights: dict[str, torch.Tensor]) -> str:
    return hashlib.sha256(b"".join(weights[name].numpy().tobytes() for name in sorted(weights))).hexdigest()


def recordings(folder: Path) -> dict[str, Any]:
    """The bytes of every recording below a folder."""
    found: dict[str, Any] = {}
    for manifest in sorted(folder.rglob("manifest.json")):
        root = manifest.parent
        found |= {f"{root.relative_to(folder)}/{name}": data for name, data in content(root).items()}
    return found


def runs_and_recordings(folder: Path) -> dict[str, Any]:
    """Both."""
    return {**runs(folder), **recordings(folder)}


def predictions(folder: Path) -> dict[str, Any]:
    """Every file of a prediction; movies by their frames' number, since parts cut elsewhere are encoded otherwise."""
    found: dict[str, Any] = {}
    for file in sorted((folder / "out").rglob("*")):
        if file.is_file() and not file.name.startswith("."):
            name = str(file.relative_to(folder))
            found[name] = _frames(file) if file.suffix == ".mp4" else file.read_bytes()
    return found


def arrangements(folder: Path) -> dict[str, Any]:
    """The outcomes of an arrangement, without seconds; how many frames each video has."""
    found: dict[str, Any] = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if file.suffix == ".json":
            found[name] = _without(json.loads(file.read_text()), "seconds")
        elif file.suffix == ".md":
            found[name] = file.read_text()
        elif file.suffix == ".mp4":
            found[name] = _frames(file)
    return found


def videos(folder: Path) -> dict[str, Any]:
    """The bytes of every video."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted((folder / "data").glob("[!.]*"))}


def _without(value: Any, key: str) -> Any:
    if isinstance(value, dict):
        return {name: _without(item, key) for name, item in value.items() if name != key}
    return [_without(item, key) for item in value] if isinstance(value, list) else value


def _frames(file: Path) -> int:
    movie, count = cv2.VideoCapture(str(file)), 0
    while movie.read()[0]:
        count += 1
    return count


def evaluations(folder: Path) -> dict[str, Any]:
    """Scores and exported files of evaluations."""
    found: dict[str, Any] = {}
    for file in sorted(folder.rglob("[!.]*")):
        name = str(file.relative_to(folder))
        if "/." in name:
            continue
        if file.name == "metrics.json":
            splits = json.loads(file.read_text())["splits"]
            # the name of the evaluation holds the commit, which whoever works on the code may change meanwhile
            found[name] = {split: {k: v for k, v in of.items() if k != "evaluation"} for split, of in splits.items()}
        elif file.suffix in (".csv", ".npz"):
            found[name] = file.read_bytes()
    return found


def not_whole(folder: Path) -> list[str]:
    """Files that are half there under their final names; names of files in the making begin with a dot.

    A recording is there when its manifest is: its arrays have their places from the start.
    """
    found = []
    for file in sorted(folder.rglob("*")):
        inside = file.relative_to(folder).parts
        if not file.is_file() or any(part.startswith(".") for part in inside):
            continue
        if file.suffix == ".npy" and not (file.parent.parent / "manifest.json").exists():
            continue
        try:
            _read(file)
        except Exception as error:  # noqa: BLE001 - whatever a reader raises, the file is not whole
            found.append(f"{file.relative_to(folder)}: {type(error).__name__}: {error}")
    return found


def _read(file: Path) -> None:
    """Reads a file with an independent reader; logs and journals, which grow, may have any end."""
    if file.suffix == ".json":
        json.loads(file.read_bytes())
    elif file.suffix == ".ckpt":
        with zipfile.ZipFile(file) as archive:
            assert archive.testzip() is None
        torch.load(file, weights_only=True)
    elif file.suffix == ".npz":
        with np.load(file, allow_pickle=False) as arrays:
            for name in arrays:
                arrays[name]
    elif file.suffix == ".npy":
        np.load(file, allow_pickle=False, mmap_mode="r")
    elif file.suffix in (".png", ".gif", ".jpg"):
        Image.open(io.BytesIO(file.read_bytes())).load()
    elif file.suffix == ".mp4":
        assert _frames(file) > 0
    elif file.suffix in (".yaml", ".md", ".csv") and file.name != "curves.csv":
        assert file.read_bytes().endswith(b"\n")


def in_the_making(folder: Path) -> list[str]:
    """What a finished command may not leave: drafts, parts, partial evaluations."""
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.name.endswith(".part") or (path.name.startswith(".") and path.is_dir() and path.name not in STAYING)
    ]


TRAIN = "apex_lab.train"
WORKS: dict[str, Work] = {
    "training": Work(TRAIN, (*TINY, *STEPS), runs),
    "training with loaders": Work(TRAIN, (*TINY, *STEPS, "++data.workers=2"), runs, workers=True),
    "training with pictures": Work(TRAIN, (*TINY, "evaluation.pictures=2", "trainer.max_steps=4"), runs),
    "own videos": Work(
        TRAIN,
        (*TINY[:3], "data=video", "scale=smoke", "data.path={inputs}/videos", "evaluation.pictures=0", *STEPS),
        runs_and_recordings,
        workers=True,
    ),
    "evaluation": Work(
        "apex_lab.evaluate",
        (
            *("checkpoint={inputs}/outputs", "trust=true", "folder=scores", "save_interval=1", "batch_size=1"),
            *("pictures=0", "export=npz"),
        ),
        evaluations,
    ),
    "prediction": Work(
        "apex_lab.predict",
        (
            *("checkpoint={inputs}/last.ckpt", "trust=true", "video={inputs}/clip.mp4", "folder=out"),
            *("chunk=2", "save_interval=4"),
        ),
        predictions,
    ),
    "sweep": Work(
        TRAIN, (*TINY, *STEPS, "seed=0,1", "hydra.sweeper.retry_failed=true", "-m"), runs
    ),  # want of memory is a failure of its job
    "simulation": Work("sims.p2d", ("--out", "data", *SMALL_P2D), recordings, workers=True),
    "arrangement clips": Work(
        "sims.arrangement_clips", ("make", "data", "--settings", CLIPS, "--workers", "1"), recordings, workers=True
    ),
    "example videos": Work(
        "sims.example_videos", ("--out", "data", "--videos", "3", "--frames", "3", "--size", "64"), videos
    ),
    "arrangement": Work(
        "apex_lab.arrange",
        ("perception=oracle", "tasks=[2]", "scenarios=2", "workers=1", "folder=out"),
        arrangements,
        workers=True,
    ),
    "arrangement video": Work(
        "apex_lab.arrange",
        ("perception=oracle", "video=[2/0]", "workers=1", "folder=out"),
        arrangements,
        workers=True,
    ),
    **{f"training {model}": Work(TRAIN, (*SQUARES, f"model={model}", *STEPS), runs) for model in MODELS},
}

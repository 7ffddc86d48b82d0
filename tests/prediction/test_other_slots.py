"""`model.slots=...` of a trained model, which no weight depends on, from the command line to the results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.conftest import TINY, Ended
from tests.videos.made import encode, moving


@pytest.fixture
def checkpoint(command: Callable[..., Ended], tmp_path: Path) -> Path:
    """A run folder of Slot Attention, trained for a step with its five slots."""
    words = ("model=slot_attention", "trainer.max_steps=1", "evaluation.videos=1", "trainer.validation_interval=null")
    ended = command("train", *TINY, *words)
    assert ended.code == 0, ended.err
    [run] = (tmp_path / "outputs").glob("*/seed_0")
    return run


def test_predictions_and_scores_have_the_slots_asked_for(
    checkpoint: Path, command: Callable[..., Ended], tmp_path: Path
) -> None:
    clip = encode(tmp_path / "clip.mkv", moving(2))
    words = (f"checkpoint={checkpoint}", "trust=true", "accelerator=cpu")
    for slots, changes in ((5, ()), (2, ("model.slots=2", "model.iterations=1"))):
        ended = command("predict", *words, f"video={clip}", "overlay=false", *changes)
        assert ended.code == 0, ended.err
        folder = Path(ended.out.splitlines()[-1])
        settings = json.loads((folder / "info.json").read_text())["settings"]
        assert settings.get("model", {}) == ({"slots": 2, "iterations": 1} if changes else {})
        assert folder.parent.name.endswith("_iterations_1_slots_2") == bool(changes)
        assert pd.read_csv(folder / "objects.csv").groupby("frame").size().max() <= slots
        ended = command("evaluate", *words, "videos=1", "pictures=0", *changes)
        assert ended.code == 0, ended.err
    found = [json.loads(file.read_text())["settings"] for file in (checkpoint / "evaluate").glob("*/metrics.json")]
    assert len(found) == 2  # each in a folder of its own
    assert {"slots": 2, "iterations": 1} in [settings.get("model") for settings in found]


def test_what_weights_depend_on_is_refused(checkpoint: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    clip = encode(tmp_path / "clip.mkv", moving(2))
    ended = command("predict", f"checkpoint={checkpoint}", "trust=true", f"video={clip}", "model.hidden=8")
    assert ended.code != 0
    assert "model.hidden = 8 cannot be changed for trained weights: only slots, iterations can." in ended.err
    assert not (tmp_path / "outputs" / "predict").exists()

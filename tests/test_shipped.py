"""The trained weights in sweeps/results fit the code: a change of the model that breaks them must ship new ones."""

from pathlib import Path

import pytest
import torch

from apex_lab.config.building import build_model
from apex_lab.config.job import check_job
from apex_lab.runs import checkpoints
from apex_lab.scene import Context, schedule_at
from tests.conftest import REPOSITORY

SHIPPED = sorted((REPOSITORY / "sweeps" / "results").glob("*.ckpt"))


def test_something_is_shipped() -> None:
    assert [path.name for path in SHIPPED] == ["apex_p2d_cpu.ckpt"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_weights_load_and_explain_a_video(path: Path) -> None:
    checkpoint = checkpoints.load(path)
    job = check_job(checkpoint["config"], checkpoint["choices"], needs_recipe=False)
    model = build_model(job.config).eval()
    model.load_state_dict(checkpoint["inference"]["weights"])
    side, frames = job.config.data["image_size"], 3
    # A grey block on the background that the weights remember is an object, and nothing else is.
    video = torch.sigmoid(model.background.bias_image.detach())[None, None].repeat(1, frames, 1, 1, 1)
    video[..., side // 2 : side // 2 + 10, side // 2 : side // 2 + 10] = 0.95
    schedule = schedule_at(dict.fromkeys(model.schedule_ranges, 1.0))
    with torch.no_grad():
        labels = model(video, Context(schedule)).segmentation()[0]
    block = labels[:, side // 2 + 2 : side // 2 + 8, side // 2 + 2 : side // 2 + 8]
    assert (block > 0).float().mean() > 0.5
    assert (labels > 0).float().mean() < 0.2


def test_it_is_small() -> None:
    assert all(path.stat().st_size < 10e6 for path in SHIPPED)

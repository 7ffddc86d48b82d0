"""`segmenter(frames)` and `segmenter.stream(frames)`."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import apex_lab
from apex_lab.inference.segmenter import NOTHING_SEEN, in_frame
from apex_lab.inference.state import leaves, refilled
from apex_lab.scene import Context, Scene
from apex_lab.videos import framing, open_video
from tests.conftest import REPOSITORY
from tests.prediction.lamps import Lamps, Patient, segmenter
from tests.videos.made import moving


@pytest.fixture(scope="module")
def apex() -> apex_lab.Segmenter:
    return apex_lab.load("apex-p2d-cpu", device="cpu")


@pytest.fixture(scope="module")
def pushing() -> np.ndarray:
    return np.stack([frame.image for frame in open_video(REPOSITORY / "examples" / "pushing.mp4").frames()])


def test_the_shipped_weights_find_the_objects_of_the_example(apex: apex_lab.Segmenter, pushing: np.ndarray) -> None:
    scene = apex(torch.from_numpy(pushing[:8]))
    assert scene.masks.shape == (1, 8, 7, 256, 256)
    assert scene.reconstruction.shape == (1, 8, 3, 256, 256)
    labels = scene.segmentation()[0]
    first, last = labels[0].unique().tolist(), labels[-1].unique().tolist()
    assert len(first) >= 4
    assert len(set(first) & set(last)) >= 4


def test_chunks_give_what_the_whole_video_gives(pushing: np.ndarray) -> None:
    """In float64: in float32 rounding grows from frame to frame."""
    apex = apex_lab.load("apex-p2d-cpu", device="cpu")
    apex.predictor.model.double().register_forward_pre_hook(lambda _, given: (given[0].double(), *given[1:]))
    whole = apex(pushing)
    for chunk in (5, 16):
        parts = list(apex.stream(iter(pushing), chunk=chunk))
        assert [part.masks.shape[1] for part in parts] == [min(chunk, 24 - start) for start in range(0, 24, chunk)]
        assert torch.equal(torch.cat([part.ids for part in parts], dim=1), whole.ids)
        masks = torch.cat([part.masks for part in parts], dim=1)
        assert (masks - whole.masks).abs().max() < 1e-9


def test_a_stored_state_continues_the_video(apex: apex_lab.Segmenter, pushing: np.ndarray) -> None:
    view = apex.framing((256, 256))
    small = np.stack([view.fitted(image) for image in pushing[:8]])
    first = apex.scene_of(small[:5])
    template = apex.scene_of(np.zeros_like(small[:1])).state
    state = refilled(template, leaves(first.state), torch.device("cpu"))
    found, wanted = (apex.scene_of(small[5:], first_frame=5, state=each) for each in (state, first.state))
    assert torch.equal(found.masks, wanted.masks)
    assert torch.equal(found.ids, wanted.ids)


def test_the_outside_of_a_crop_is_background() -> None:
    scene = segmenter()(moving(3))
    assert scene.masks.shape == (1, 3, 3, 48, 64)
    assert torch.equal(scene.masks.sum(dim=2), torch.ones(1, 3, 48, 64))
    assert (scene.segmentation()[..., :8] == 0).all()
    assert (scene.segmentation()[0, 0, 8:24, 8:16] == 2).all()


def test_models_without_background_get_a_component_for_the_outside() -> None:
    class Bare(Lamps):
        def forward(self, video: Tensor, context: Context) -> Scene:
            return dataclasses.replace(super().forward(video, context), background=torch.zeros(3, dtype=torch.bool))

    scene = segmenter(Bare())(moving(2))
    assert scene.masks.shape == (1, 2, 4, 48, 64)
    assert scene.background.tolist() == [False, False, False, True]
    assert (scene.segmentation()[..., :8] == NOTHING_SEEN).all()
    assert (scene.segmentation()[..., 8:56] != NOTHING_SEEN).all()
    assert segmenter(Bare(), (64, 64), "letterbox")(moving(2)).masks.shape == (1, 2, 3, 48, 64)


def test_scenes_of_the_model_s_size_on_request() -> None:
    made = segmenter(size=(24, 24), full_size=False)
    assert made(moving(2)).masks.shape == (1, 2, 3, 24, 24)
    assert next(made.stream(moving(2))).masks.shape == (1, 2, 3, 24, 24)


@pytest.mark.parametrize("fit", ["crop", "letterbox"])
def test_windows_are_those_of_the_frame(fit: apex_lab.videos.Fit) -> None:
    view = framing((60, 100), (32, 32), fit)
    scene = segmenter()(moving(1))
    # a window that is the seen part of the frame, whatever that is
    target = view.target
    of_input = [
        *(target.height / 32, target.width / 32),
        *((2 * target.top + target.height) / 32 - 1, (2 * target.left + target.width) / 32 - 1),
    ]
    scene = dataclasses.replace(
        scene,
        masks=torch.zeros(1, 1, 3, 32, 32),
        reconstruction=torch.zeros(1, 1, 3, 32, 32),
        windows=torch.tensor(of_input).expand(1, 1, 3, 4),
    )
    found = in_frame(scene, view).windows
    assert found is not None
    source = view.source
    wanted = [
        *(source.height / 60, source.width / 100),
        *((2 * source.top + source.height) / 60 - 1, (2 * source.left + source.width) / 100 - 1),
    ]
    assert found[0, 0, 0].tolist() == pytest.approx(wanted, abs=1e-6)


def test_other_input_is_refused_in_one_sentence() -> None:
    made = segmenter()
    frames = moving(2)
    cases: list[tuple[object, str]] = [
        (frames.astype(np.float32), "frames are float32: give uint8, 0 to 255."),
        (np.full(frames.shape, np.nan), "frames are float64 and hold NaN or infinity: give uint8, 0 to 255."),
        (
            frames[..., :1],
            "frames have the shape (2, 48, 64, 1): give (T, H, W, 3), RGB in the last place, none of it 0.",
        ),
        (frames[0], "frames have the shape (48, 64, 3): give (T, H, W, 3), RGB in the last place, none of it 0."),
        (frames[:0], "frames have the shape (0, 48, 64, 3): give (T, H, W, 3), RGB in the last place, none of it 0."),
        (torch.from_numpy(frames).permute(0, 3, 1, 2), "frames have the shape (2, 3, 48, 64): give (T, H, W, 3)"),
        ([frames], "frames are a list: give a NumPy array or a PyTorch tensor of uint8."),
    ]
    call = type(made).__call__
    call = getattr(call, "__wrapped__", call)  # without the tests' own check of types
    for given, words in cases:
        with pytest.raises(apex_lab.UserError) as caught:
            call(made, given)
        assert str(caught.value).startswith(words)
    with pytest.raises(apex_lab.UserError, match=r"frame 1 is \(40, 64\), the first \(48, 64\)"):
        list(made.stream([frames[0], frames[0, :40]]))
    with pytest.raises(apex_lab.UserError, match="chunk = 0 is wrong"):
        made.stream(frames, chunk=0)
    with pytest.raises(apex_lab.UserError, match=r"Patient needs the whole video at once: call segmenter\(frames\)"):
        segmenter(Patient()).stream(frames)
    assert list(made.stream([])) == []


def test_a_checkpoint_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        apex_lab.UserError, match=r"checkpoint = apex-p2d-cup does not exist; did you mean 'apex-p2d-cpu'\?"
    ):
        apex_lab.load("apex-p2d-cup")
    with pytest.raises(apex_lab.UserError, match="device = 'gpux' cannot be used"):
        apex_lab.load("apex-p2d-cpu", device="gpux")
    (tmp_path / "bad.ckpt").write_text("no checkpoint")
    with pytest.raises(apex_lab.UserError, match=r"bad\.ckpt is no checkpoint"):
        apex_lab.load(tmp_path / "bad.ckpt")


def test_importing_apex_lab_is_fast_and_brings_no_pytorch() -> None:
    code = (
        "import time, sys; began = time.process_time(); import apex_lab; used = time.process_time() - began;"
        "print(used, *(name in sys.modules for name in ('torch', 'numpy')))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ})
    used, *imported = ended.stdout.split()
    assert float(used) < 0.3
    assert imported == ["False", "False"]
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        apex_lab.lode  # noqa: B018
    assert {"load", "Segmenter", "Scene", "UserError"} <= set(dir(apex_lab))

"""A stand-in for the P2D simulator: moving rectangles, in a millisecond, a function of (seed, split, index) alone.

Workers import it by name. Environment variables make it misbehave:
    FAKE_LOG=<folder>            leaves an empty file <split>-<index>-<pid>-<nanoseconds> per trajectory made
    FAKE_SLEEP_S=<seconds>       time that a trajectory takes
    FAKE_KILL=<split>-<index>    the worker kills itself there, always
    FAKE_KILL_ONCE=<folder>      every worker's first trajectory with an even index kills it, once per index
    FAKE_RAISE=<split>-<index>   raises a RuntimeError there
    FAKE_REFUSE=<split>-<index>  raises a SimError there
    FAKE_FILL=<folder>           fills the disk of that folder at the trajectory train-3
    FAKE_VERSION=<text>          its version
    FAKE_OTHER_BYTES=1           other bytes than usual
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
import zlib
from pathlib import Path

import numpy as np

from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.trajectory import Trajectory


def facts(settings: Settings) -> dict[str, object]:
    camera = {"intrinsics": np.eye(3).tolist(), "extrinsics": np.eye(4).tolist()}
    versions = {"fake": os.environ.get("FAKE_VERSION", "1")}
    return {"versions": versions, "camera": camera, "classes": list(settings.objects)}


def simulate(settings: Settings, split: str, index: int) -> Trajectory:
    _misbehave(split, index)
    rng = np.random.default_rng([settings.seed, zlib.crc32(split.encode()), index])
    frames, size, slots = settings.frames, settings.image_size, settings.max_objects
    used = int(rng.integers(settings.min_objects, slots + 1))
    corner = rng.integers(0, size // 2, (used + 1, 2))
    side = rng.integers(size // 8, size // 3, (used + 1, 2))
    step = rng.integers(0, 3, (used + 1, 2))
    rgb = rng.integers(0, 40, (frames, size, size, 3), dtype=np.uint8)
    segmentation = np.zeros((frames, size, size), np.uint8)
    amodal = np.zeros((frames, slots + 1), np.int32)
    colours = rng.integers(60, 256, (used + 1, 3), dtype=np.uint8)
    for frame in range(frames):
        for part in [*range(1, used + 1), 0]:  # the arm stands in front
            low = corner[part] + frame * step[part]
            box = (frame, slice(low[0], low[0] + side[part, 0]), slice(low[1], low[1] + side[part, 1]))
            segmentation[box] = 1 + part
            rgb[box] = colours[part]
            amodal[frame, part] = segmentation[box].size
    visible = np.stack([(segmentation == 1 + part).sum((1, 2)) for part in range(slots + 1)], axis=1)
    classes = np.full(slots, -1, np.int16)
    classes[:used] = rng.choice(len(settings.objects), used, replace=False)
    poses = np.full((frames, slots, 7), np.nan, np.float32)
    travel = np.arange(frames)[:, None, None] * step[None, 1:] / 100
    poses[:, :used] = np.concatenate([corner[None, 1:] / size + travel, np.zeros((frames, used, 5))], axis=2)
    poses[:, :used, 6] = 1
    contact = np.zeros((frames, slots), bool)
    contact[:, :used] = rng.random((frames, used)) < 0.3
    other = int(os.environ.get("FAKE_OTHER_BYTES", 0))
    return Trajectory(
        rgb=rgb + np.uint8(other),
        segmentation=segmentation,
        depth=rng.uniform(0.5, 2, (frames, size, size)).astype(np.float16),
        classes=classes,
        poses=poses,
        joints=rng.normal(size=(frames, 9)).astype(np.float32),
        gripper=rng.normal(size=(frames, 7)).astype(np.float32),
        visible_px=visible.astype(np.int32),
        amodal_px=amodal,
        arm_contact=contact,
        object_contact=np.zeros((frames, slots, slots), bool),
        aimed=bool(rng.random() < settings.aim),
        redraws=int(rng.integers(0, 3)),
    )


def _misbehave(split: str, index: int) -> None:
    name = f"{split}-{index}"
    env = os.environ
    if "FAKE_LOG" in env:
        Path(env["FAKE_LOG"], f"{name}-{os.getpid()}-{time.monotonic_ns()}").touch()
    time.sleep(float(env.get("FAKE_SLEEP_S", 0)))
    if env.get("FAKE_KILL") == name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "FAKE_KILL_ONCE" in env and index % 2 == 0:
        mark = Path(env["FAKE_KILL_ONCE"], name)
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    if env.get("FAKE_RAISE") == name:
        raise RuntimeError("the fake fell over")
    if env.get("FAKE_REFUSE") == name:
        raise SimError("the fake does not like this one")
    if "FAKE_FILL" in env and name == "train-3":
        with contextlib.suppress(OSError), open(Path(env["FAKE_FILL"], "other_peoples_file"), "wb") as file:
            while True:
                file.write(bytes(4096))
                file.flush()

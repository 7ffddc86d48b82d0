"""Speed of P2D's simulation, compared with a straightforward scene: `python -m sims.p2d.bench_simulation`.

The naive scene is one PyBullet server per process, reset and loaded again for every trajectory, with the Panda's own
meshes, the scans at full resolution, PyBullet's plane and table, and one `getCameraImage` with shadows per frame. It
takes the same physics steps for the same specifications but computes no amodal counts, which P2D does, so the ratio
understates the gain. Both are measured alternately in one process, in processor time and in wall-clock time, because
other work on the machine slows only the latter.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sims import arm as panda
from sims.assets import object_models
from sims.bullet import Client, load_pybullet_data
from sims.command import ending
from sims.objects import CATALOGUE
from sims.p2d.settings import Settings
from sims.p2d.simulate import simulate, steps_of
from sims.p2d.spec import Spec, sample
from sims.scans import scan_file
from sims.world import STEPS_PER_S


@dataclass
class Clock:
    """Seconds spent on frames of one kind."""

    frames: int = 0
    processor_s: float = 0.0
    wall_s: float = 0.0

    def run(self, work: Callable[[], int]) -> None:
        """Time `work`, which returns how many frames it made."""
        processor, wall = time.process_time(), time.perf_counter()
        self.frames += work()
        self.processor_s += time.process_time() - processor
        self.wall_s += time.perf_counter() - wall

    @property
    def per_core(self) -> float:
        """Frames per second of processor time."""
        return self.frames / self.processor_s


class NaiveScene:
    """Physics and rendering in one server, with the original models."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.bullet = Client()
        self.data = load_pybullet_data()
        self.models = object_models(settings.objects, None, settings.image_size)
        self.scans = {entry.name: str(scan_file(entry)) for entry in CATALOGUE}

    def play(self, spec: Spec) -> int:
        """Load, settle, push and render one trajectory; returns its number of frames."""
        call = self.bullet.call
        call("resetSimulation")
        call("setGravity", 0, 0, -9.81)
        call("loadURDF", f"{self.data}/plane.urdf", [0, 0, -0.65])
        call("loadURDF", f"{self.data}/table/table.urdf", [0.5, 0, -0.65], useFixedBase=True)
        arm = call("loadURDF", f"{self.data}/franka_panda/panda.urdf", useFixedBase=True)
        for placement in spec.objects:
            self._add(placement.class_index, placement.position, placement.quaternion)
        ends = np.array([[*point, spec.height_m] for point in (spec.start, spec.end)])
        angles, _ = panda.joint_path(self.bullet, arm, np.linspace(ends[0], ends[1], 12), spec.yaw_rad)
        for _ in range(STEPS_PER_S // 4):
            call("stepSimulation")
        steps = steps_of(self.settings, spec)
        for frame in range(self.settings.frames):
            begin, end = (round(steps * max(0, f) / max(1, self.settings.frames - 1)) for f in (frame - 1, frame))
            for step in range(begin, end):
                target = angles[min(len(angles) - 1, step * len(angles) // steps)]
                call(
                    "setJointMotorControlArray",
                    arm,
                    panda.JOINTS[:7],
                    self.bullet.module.POSITION_CONTROL,
                    targetPositions=target.tolist(),
                )
                call("stepSimulation")
            self._draw()
        return self.settings.frames

    def _add(self, class_index: int, position: tuple[float, ...], quaternion: tuple[float, ...]) -> None:
        call, mesh = self.bullet.call, self.bullet.module.GEOM_MESH
        model = self.models[class_index]
        touch = call("createCollisionShape", mesh, fileName=str(model.collision))
        seen = call("createVisualShape", mesh, fileName=self.scans[model.name])
        call("createMultiBody", model.mass_kg, touch, seen, position, quaternion)

    def _draw(self) -> None:
        camera, size = self.settings.camera, self.settings.image_size
        self.bullet.call(
            "getCameraImage",
            size,
            size,
            camera.view_matrix(),
            camera.projection_matrix(),
            shadow=1,
            renderer=self.bullet.module.ER_TINY_RENDERER,
        )


def measure(settings: Settings, trajectories: int) -> tuple[Clock, Clock]:
    """Time the naive scene and P2D alternately on the same trajectories; the first of each is warm-up."""
    naive, product = Clock(), Clock()
    scene = NaiveScene(settings)

    def make(index: int) -> int:
        simulate(settings, "train", index)
        return settings.frames

    for index in range(trajectories + 1):
        spec = sample(settings, "train", index)
        clocks = (naive, product) if index else (Clock(), Clock())
        clocks[0].run(lambda spec=spec: scene.play(spec))  # type: ignore[misc]
        clocks[1].run(lambda index=index: make(index))  # type: ignore[misc]
    scene.bullet.close()
    return naive, product


def main() -> int:
    """Print the speeds, their ratio, and the time for the whole data set; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m sims.p2d.bench_simulation", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--trajectories", type=int, default=12, help="trajectories to time (default 12)")
    parser.add_argument("--image-size", type=int, default=128, help="side of the images in pixels (default 128)")
    parser.add_argument("--renderer", choices=["tiny", "egl"], default="tiny", help="renderer of P2D (default tiny)")
    words = parser.parse_args()
    return ending(lambda: _run(words), "nothing is stored")


def _run(words: argparse.Namespace) -> int:
    settings = Settings(image_size=words.image_size, renderer=words.renderer)
    naive, product = measure(settings, max(1, words.trajectories))
    print(f"{settings.image_size} x {settings.image_size}, {settings.frames} frames, {words.trajectories} trajectories")
    for name, clock in (("naive scene", naive), ("P2D", product)):
        wall = clock.frames / clock.wall_s
        print(f"{name:12} {clock.per_core:6.1f} frames per second and core, {wall:6.1f} by the wall clock")
    print(f"ratio        {product.per_core / naive.per_core:6.1f}")
    whole = (settings.train + settings.val + settings.test) * settings.frames
    for cores in sorted({1, 2, os.cpu_count() or 1}):
        print(
            f"whole P2D    {whole / product.per_core / cores / 60:6.1f} minutes for {whole} frames on {cores} core(s)"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""One pushing episode: physics first, then images and labels from the recorded poses alone."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from sims import arm as panda
from sims.assets import ObjectModel, object_models
from sims.background import TABLE_HIGH_M, TABLE_LOW_M
from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.spec import SEEN, NoRoom, Spec, sample
from sims.p2d.trajectory import Trajectory
from sims.poses import moved
from sims.render import Renderer
from sims.world import STEPS_PER_S, World

CROWDED = 40
"""If this many first attempts all find no room for the objects, the settings are refused as impossible. With five
objects, two of three attempts find none, so that fewer would refuse a large data set for one unlucky trajectory."""
SETTLE_S = 1.5
REST_M_S, REST_RAD_S = 0.005, 0.05
REST_STEPS = 24
RAMP_S = 0.25
WAYPOINT_M = 0.06
REACH_ERROR_M = 0.001
START_GAP_M = 0.01
IN_PICTURE = 0.9
"""Minimum share of an object's vertices inside the image, in every frame."""
STILL_M, STILL_RAD = 1e-4, 1e-3
"""An object that moved less than this since its last recorded pose keeps that pose: no jitter at rest."""


class Unusable(Exception):
    """This attempt is rejected; sample another."""


@dataclass(frozen=True)
class Episode:
    """Result of the physics, frame by frame: float32 arrays as in `Trajectory`, for the used slots only."""

    poses: np.ndarray
    joints: np.ndarray
    gripper: np.ndarray
    arm_contact: np.ndarray
    object_contact: np.ndarray


@lru_cache(maxsize=1)
def _world(process: int) -> World:
    return World()


@lru_cache(maxsize=1)
def _renderer(process: int, settings: Settings) -> Renderer:
    return Renderer(settings.camera, settings.image_size, settings.renderer)


def camera(settings: Settings) -> dict[str, object]:
    """The camera as plain JSON data.

    intrinsics 3 x 3 (pixels), extrinsics 4 x 4 (world to camera, OpenCV axes), near and far in metres, eye and target
    in metres, fov in degrees (vertical), image_size in pixels.
    """
    view = settings.camera
    return {
        "intrinsics": view.intrinsics(settings.image_size).tolist(),
        "extrinsics": view.extrinsics().tolist(),
        "near": view.near_m,
        "far": view.far_m,
        "eye": list(view.eye),
        "target": list(view.target),
        "fov": view.fov_deg,
        "image_size": settings.image_size,
    }


def simulate(settings: Settings, split: str, index: int) -> Trajectory:
    """Generate one trajectory; its bytes depend on the settings, the split's name and the index alone.

    Raises:
        SimError: PyBullet or a model is missing, the objects find no room, or no attempt within `max_redraws` was
            usable.
    """
    models = object_models(settings.objects, settings.objects_root, settings.image_size)
    reasons: list[str] = []
    crowded = 0
    for attempt in range(settings.max_redraws + 1):
        try:
            spec = sample(settings, split, index, attempt)
            return _label(settings, spec, push(settings, spec, models), models)
        except Unusable as reason:
            reasons.append(str(reason))
        except NoRoom as reason:
            reasons.append("there was no room")
            crowded += 1
            if crowded == len(reasons) == CROWDED:
                raise SimError(str(reason)) from None
    raise SimError(
        f"Trajectory {index} of split {split!r} (seed {settings.seed}) found no usable push in {len(reasons)} attempts "
        f"(the last: {reasons[-1]}): check camera, workspace_x and workspace_y, or raise max_redraws."
    )


def push(settings: Settings, spec: Spec, models: tuple[ObjectModel, ...]) -> Episode:
    """Run the physics of one attempt.

    Raises:
        Unusable: with the reason.
    """
    world = _world(os.getpid())
    world.rebuild()
    for placement in spec.objects:
        world.add_object(models[placement.class_index], np.array(placement.position), np.array(placement.quaternion))
    _settle(world)
    world.add_arm()
    path = _path(world, spec)
    for body in world.objects:
        if world.gap(body, START_GAP_M) < START_GAP_M:
            raise Unusable("an object lay against the arm's start")
    return _record(settings, world, path, models, spec)


def _settle(world: World) -> None:
    calm = 0
    for _ in range(int(SETTLE_S * STEPS_PER_S)):
        world.step()
        linear, angular = world.fastest()
        calm = calm + 1 if linear < REST_M_S and angular < REST_RAD_S else 0
        if calm >= REST_STEPS:
            return
    raise Unusable("the objects did not come to rest")


def _path(world: World, spec: Spec) -> np.ndarray:
    """(N, 7) joint angles at evenly spaced points of the line."""
    start, end = (np.array([*point, spec.height_m]) for point in (spec.start, spec.end))
    count = max(4, int(np.ceil(np.linalg.norm(end - start) / WAYPOINT_M)) + 1)
    points = start + np.linspace(0, 1, count)[:, None] * (end - start)
    angles, error = panda.joint_path(world.bullet, world.arm, points, spec.yaw_rad)
    if error > REACH_ERROR_M:
        raise Unusable("the arm does not reach the whole line")
    return angles


def duration_s(settings: Settings, spec: Spec) -> float:
    """Duration of the push."""
    return float(np.linalg.norm(np.subtract(spec.end, spec.start))) / settings.speed_m_s + RAMP_S


def steps_of(settings: Settings, spec: Spec) -> int:
    """Physics steps of the push."""
    return int(np.ceil(duration_s(settings, spec) * STEPS_PER_S))


def progress(time_s: np.ndarray, duration_s: float) -> np.ndarray:
    """Share of the line covered at a time: constant speed with a smooth start and stop of `RAMP_S` each."""
    ramp = min(RAMP_S, duration_s / 3)
    time_s = np.clip(time_s, 0, duration_s)
    late = duration_s - time_s
    top = 1 / (duration_s - ramp)
    rising = top * time_s**2 / (2 * ramp)
    falling = 1 - top * late**2 / (2 * ramp)
    steady = top * (time_s - ramp / 2)
    return np.where(time_s < ramp, rising, np.where(late < ramp, falling, steady))


def _record(settings: Settings, world: World, path: np.ndarray, models: tuple[ObjectModel, ...], spec: Spec) -> Episode:
    duration = duration_s(settings, spec)
    steps = steps_of(settings, spec)
    share = progress(np.arange(steps + 2) / STEPS_PER_S, duration)
    knots = np.linspace(0, 1, len(path))
    angles = CubicSpline(knots, path)(share)
    fingers = np.zeros((len(angles), 2))
    positions = np.concatenate([angles, fingers], axis=1)
    speeds = (np.diff(positions, axis=0) * STEPS_PER_S).tolist()
    positions = positions.tolist()
    stops = np.round(np.linspace(0, steps, settings.frames)).astype(int)
    used = [models[placement.class_index] for placement in spec.objects]
    count = len(used)
    frames: list[tuple[np.ndarray, ...]] = []
    arm_contact, object_contact = np.zeros(count, dtype=bool), np.zeros((count, count), dtype=bool)
    step = 0
    for stop in stops:
        while step < stop:
            world.drive(positions[step + 1], speeds[step])
            world.step()
            touched, met = world.contacts()
            arm_contact[touched] = True
            for one, other in met:
                object_contact[one, other] = object_contact[other, one] = True
            step += 1
        poses = _steady(world.poses(), frames[-1][0] if frames else None)
        _check(settings, poses, used)
        frames.append((poses, world.joints(), world.gripper(), arm_contact.copy(), object_contact.copy()))
        arm_contact[:], object_contact[:] = False, False
    poses, joints, gripper, arm_touch, object_touch = (np.stack(column) for column in zip(*frames, strict=True))
    return Episode(
        poses.astype(np.float32), joints.astype(np.float32), gripper.astype(np.float32), arm_touch, object_touch
    )


def _steady(poses: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Poses (O, 7), with the previous pose for objects that have not moved."""
    if before is None:
        return poses
    shift = np.linalg.norm(poses[:, :3] - before[:, :3], axis=1)
    cosine = np.abs((poses[:, 3:] * before[:, 3:]).sum(axis=1))
    still = (shift < STILL_M) & (2 * np.arccos(np.minimum(cosine, 1)) < STILL_RAD)
    return np.where(still[:, None], before, poses)


def _check(settings: Settings, poses: np.ndarray, models: list[ObjectModel]) -> None:
    for model, pose in zip(models, poses, strict=True):
        points = moved(model.vertices, pose)
        if points[:, 2].max() < 0 or (pose[:2] < TABLE_LOW_M).any() or (pose[:2] > TABLE_HIGH_M).any():
            raise Unusable("an object left the table")
        pixels, _ = settings.camera.project(points, settings.image_size)
        inside = (pixels >= 0).all(axis=1) & (pixels < settings.image_size).all(axis=1)
        if inside.mean() < IN_PICTURE:
            raise Unusable("an object left the image")


def _label(settings: Settings, spec: Spec, episode: Episode, models: tuple[ObjectModel, ...]) -> Trajectory:
    """Render every frame of an episode and pad the slots.

    Raises:
        Unusable: an object is hidden, or nearly so, in all frames.
    """
    renderer = _renderer(os.getpid(), settings)
    renderer.show(tuple(models[placement.class_index] for placement in spec.objects))
    used, slots = len(spec.objects), settings.max_objects
    pictures = []
    for joints, poses in zip(episode.joints, episode.poses, strict=True):
        pictures.append(renderer.picture(joints, poses))
    segmentation = np.stack([picture.segmentation for picture in pictures])
    visible = np.stack([(segmentation == 1 + part).sum(axis=(1, 2)) for part in range(slots + 1)], axis=1)
    amodal = np.stack([picture.amodal_px for picture in pictures])
    if (visible[:, 1 : used + 1] / np.maximum(amodal[:, 1:], 1)).max(axis=0).min() < SEEN:
        raise Unusable("an object is hidden in every frame")
    padded = slots - used
    return Trajectory(
        rgb=np.stack([picture.rgb for picture in pictures]),
        segmentation=segmentation,
        depth=np.stack([picture.depth for picture in pictures]).astype(np.float16),
        classes=np.array([placement.class_index for placement in spec.objects] + [-1] * padded, dtype=np.int16),
        poses=np.pad(episode.poses, ((0, 0), (0, padded), (0, 0)), constant_values=np.nan),
        joints=episode.joints,
        gripper=episode.gripper,
        visible_px=visible.astype(np.int32),
        amodal_px=np.pad(amodal, ((0, 0), (0, padded))).astype(np.int32),
        arm_contact=np.pad(episode.arm_contact, ((0, 0), (0, padded))),
        object_contact=np.pad(episode.object_contact, ((0, 0), (0, padded), (0, padded))),
        aimed=spec.aimed,
        redraws=spec.attempt,
    )

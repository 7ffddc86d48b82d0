"""A simulated trajectory: the interface between the simulator, which generates it, and the store, which writes it.

Legend: T frames, H, W image size, O = `max_objects` object slots (unused ones are padded).
Segmentation ids: 0 background (table, floor, everything static), 1 the arm with all its links, 2 + o object slot o.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BACKGROUND_ID = 0
ARM_ID = 1
FIRST_OBJECT_ID = 2


@dataclass(frozen=True)
class Trajectory:
    """One pushing episode.

    Attributes:
        rgb: (T, H, W, 3) uint8.
        segmentation: (T, H, W) uint8, ids as above, from the same render as `rgb`.
        depth: (T, H, W) float16, metres along the optical axis.
        classes: (O,) int16, index into the object catalogue; -1 for an unused slot.
        poses: (T, O, 7) float32, object frame in the world: x, y, z in metres, quaternion x, y, z, w; NaN if unused.
        joints: (T, 9) float32, the arm's seven joint angles in radians and two finger positions in metres.
        gripper: (T, 7) float32, pose of the gripper in the world, as `poses`.
        visible_px: (T, O + 1) int32, visible pixels of the arm (index 0) and of each object slot (1 + o).
        amodal_px: (T, O + 1) int32, pixels each would cover without occlusion (within the image).
        arm_contact: (T, O) bool, the arm touched the object at any physics step since the frame before.
        object_contact: (T, O, O) bool, symmetric, likewise between objects.
        aimed: the line was sampled to meet an object.
        redraws: number of attempts rejected before this one (an object left the table, no room, ...).
    """

    rgb: np.ndarray
    segmentation: np.ndarray
    depth: np.ndarray
    classes: np.ndarray
    poses: np.ndarray
    joints: np.ndarray
    gripper: np.ndarray
    visible_px: np.ndarray
    amodal_px: np.ndarray
    arm_contact: np.ndarray
    object_contact: np.ndarray
    aimed: bool
    redraws: int

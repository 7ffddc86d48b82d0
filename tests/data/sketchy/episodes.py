"""Writes Sketchy episodes as the release has them: TFRecord files of Examples with 30 features.

The writer knows nothing of the reader: protocol buffers and checksums are made here by other means.
"""

from __future__ import annotations

import io
import struct
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import crc32c
import numpy as np
from PIL import Image

FRONT = ("pixels/basket_front_left", "pixels/basket_front_right")

Value = list[bytes] | list[float] | list[int]


def varint(number: int) -> bytes:
    """Base 128, little end first; negative numbers modulo 2^64."""
    number %= 2**64
    digits = bytearray()
    while True:
        digits.append(number % 128 + (128 if number >= 128 else 0))
        number //= 128
        if not number:
            return bytes(digits)


def delimited(field: int, content: bytes) -> bytes:
    """A length-delimited field."""
    return varint(field * 8 + 2) + varint(len(content)) + content


def feature(values: Value, packed: bool = True) -> bytes:
    """A Feature; numbers packed or one by one."""
    if isinstance(values[0], bytes):
        return delimited(1, b"".join(delimited(1, value) for value in values))  # type: ignore[arg-type]
    if isinstance(values[0], float):
        floats = [struct.pack("<f", value) for value in values]  # type: ignore[arg-type]
        return delimited(2, delimited(1, b"".join(floats)) if packed else b"".join(b"\x0d" + one for one in floats))
    numbers = [varint(value) for value in values]  # type: ignore[arg-type]
    return delimited(3, delimited(1, b"".join(numbers)) if packed else b"".join(b"\x08" + one for one in numbers))


def example(features: Mapping[str, Value], packed: bool = True, order: Sequence[str] | None = None) -> bytes:
    """An Example with its features in the given order."""
    entries = [
        delimited(1, name.encode()) + delimited(2, feature(features[name], packed)) for name in order or features
    ]
    return delimited(1, b"".join(delimited(1, entry) for entry in entries))


def checksum(data: bytes) -> bytes:
    """Masked CRC-32C."""
    crc = crc32c.crc32c(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32)


def record(payload: bytes) -> bytes:
    """A TFRecord."""
    length = struct.pack("<Q", len(payload))
    return length + checksum(length) + payload + checksum(payload)


def jpeg(image: np.ndarray, quality: int = 90) -> bytes:
    """Baseline JPEG; colour with 4:2:0 chroma."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=quality, subsampling=2 if image.ndim == 3 else -1)
    return stream.getvalue()


def plain(grey: int, height: int = 600, width: int = 960) -> np.ndarray:
    """An image of one grey level."""
    return np.full((height, width, 3), grey, np.uint8)


def level(timestep: int, episode: int = 0, camera: int = 0) -> int:
    """The grey level that `timestep_features` gives to an image."""
    return 20 + 4 * (timestep % 40) + 3 * episode + camera


_SMALL = {
    name: jpeg(np.full(shape, 90, np.uint8))
    for name, shape in {
        "pixels/basket_back_left": (600, 960, 3),
        "pixels/usbcam0": (768, 1024, 3),
        "pixels/usbcam1": (768, 1024, 3),
        "pixels/royale_camera_driver_gray": (171, 224),
    }.items()
}


def timestep_features(
    timestep: int, episode: int = 0, image: Callable[[int, int], np.ndarray] | None = None
) -> dict[str, Value]:
    """The 30 features of a timestep.

    Args:
        timestep, episode: encoded in the grey level of the front cameras' images.
        image: (timestep, camera 0 or 1) -> image of a front camera instead.
    """
    draw = np.random.default_rng([episode, timestep])

    def numbers(count: int) -> list[float]:
        return [float(value) for value in draw.normal(size=count).astype(np.float32)]

    drawn = image or (lambda t, camera: plain(level(t, episode, camera)))
    features: dict[str, Value] = {name: [jpeg(drawn(timestep, camera))] for camera, name in enumerate(FRONT)}
    features |= {name: [content] for name, content in _SMALL.items()}
    features["pixels/royale_camera_driver_depth"] = [
        float(value) for value in draw.uniform(0, 0.37, 171 * 224).astype("f4")
    ]
    features["actions"] = numbers(7)
    features["gripper/grasp"] = [int(draw.integers(-1, 2))]
    for name in ("angle", "velocity", "torque"):
        features[f"gripper/joints/{name}"] = numbers(1)
        features[f"sawyer/joints/{name}"] = numbers(7)
    features |= {f"sawyer/{name}": numbers(7) for name in ("pinch/pose", "tcp/pose")}
    features |= {f"sawyer/tcp/{name}": numbers(6) for name in ("velocity", "effort")}
    features |= {f"wrist/{name}": numbers(3) for name in ("force", "torque")}
    features["gripper/arrival_time"] = [1.5e9]
    for name in ("sawyer/joints", "wrist", "pixels/royale_camera_driver_depth", "pixels/royale_camera_driver_gray"):
        features |= {f"{name}/{time}": [1.5e9] for time in ("arrival_time", "sensor_time")}
    return features


def episode_name(number: int) -> str:
    """`<digits>_<UUID>`; names are in the order of numbers."""
    return f"{10000313341320364000 + number}_{uuid.UUID(int=number)}"


def write_episode(
    folder: Path, number: int, timesteps: int, image: Callable[[int, int], np.ndarray] | None = None, few: bool = True
) -> Path:
    """Writes an episode; returns its file.

    Args:
        folder: where.
        number: of the episode.
        timesteps: how many.
        image: as for `timestep_features`.
        few: with the features of the front cameras alone, which is faster.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / episode_name(number)
    with open(path, "wb") as file:
        for timestep in range(timesteps):
            features = front_features(timestep, number, image) if few else timestep_features(timestep, number, image)
            order = list(features)
            np.random.default_rng([number, timestep, 1]).shuffle(order)
            file.write(record(example(features, packed=timestep % 2 == 0, order=order)))
    return path


def front_features(
    timestep: int, episode: int = 0, image: Callable[[int, int], np.ndarray] | None = None
) -> dict[str, Value]:
    """The features of the front cameras and two small ones."""
    drawn = image or (lambda t, camera: plain(level(t, episode, camera)))
    features: dict[str, Value] = {name: [jpeg(drawn(timestep, camera))] for camera, name in enumerate(FRONT)}
    return features | {"actions": [0.5, -1.0], "gripper/grasp": [-1]}

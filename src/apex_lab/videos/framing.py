"""Frames of any size to a model's input size, and masks back to the frame's own pixels."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Fit = Literal["crop", "letterbox"]
"""crop: the largest rectangle of the input's shape in the middle; letterbox: all of the frame, with black bars."""


@dataclass(frozen=True)
class Rectangle:
    """Whole pixels of an image: the first row and column, height, width."""

    top: int
    left: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


@dataclass(frozen=True)
class Framing:
    """What of a frame is seen, and where in the model's input it lies.

    Attributes:
        fit: how it was chosen.
        frame: (H, W) of the video.
        input: (h, w) of the model's input.
        source: the part of the frame that is seen.
        target: the part of the input that shows it; the rest is black.
    """

    fit: Fit
    frame: tuple[int, int]
    input: tuple[int, int]
    source: Rectangle
    target: Rectangle

    def fitted(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """A frame at the model's input size: averaged over areas where it shrinks, else bilinear."""
        seen = _resized(image[self.source.slices], (self.target.height, self.target.width))
        if (self.target.height, self.target.width) == self.input:
            return np.ascontiguousarray(seen)
        found = np.zeros((*self.input, 3), dtype=np.uint8)
        found[self.target.slices] = seen
        return found

    def of_target(self, masks: Float[np.ndarray, "*batch h w"]) -> Float[np.ndarray, "*batch h2 w2"]:
        """The part of masks at the input's size that shows the frame."""
        return masks[(..., *self.target.slices)]

    def described(self) -> dict[str, Any]:
        """Plain values for a file, in pixels."""
        return {
            "fit": self.fit,
            "frame_height_width": list(self.frame),
            "input_height_width": list(self.input),
            "seen_part_of_frame": asdict(self.source),
            "its_place_in_input": asdict(self.target),
        }


def framing(frame: tuple[int, int], input: tuple[int, int], fit: Fit) -> Framing:
    """The framing of frames of one size.

    Args:
        frame: (H, W) of the video, at least 1 x 1.
        input: (h, w) of the model's input.
        fit: what to do where the shapes differ.
    """
    if fit == "crop":
        return Framing(fit, frame, input, _centred(frame, _largest(input, frame)), Rectangle(0, 0, *input))
    return Framing(fit, frame, input, Rectangle(0, 0, *frame), _centred(input, _largest(frame, input)))


def _largest(shape: tuple[int, int], inside: tuple[int, int]) -> tuple[int, int]:
    """The largest (height, width) of the proportions of `shape` that fits inside, at least 1 x 1."""
    scale = min(inside[0] / shape[0], inside[1] / shape[1])
    return max(1, min(inside[0], round(shape[0] * scale))), max(1, min(inside[1], round(shape[1] * scale)))


def _centred(outer: tuple[int, int], inner: tuple[int, int]) -> Rectangle:
    return Rectangle((outer[0] - inner[0]) // 2, (outer[1] - inner[1]) // 2, *inner)


def _resized(image: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)

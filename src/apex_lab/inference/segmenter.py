"""A trained model for frames of any size: `segmenter(frames)`, `segmenter.stream(frames)`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.inference.predictor import Predictor
from apex_lab.inference.sizes import as_float, resized_images
from apex_lab.metrics.scenes import resize_masks
from apex_lab.scene import Scene
from apex_lab.videos import Fit, Framing, framing

NOTHING_SEEN = 2**53
"""Identity of what lies outside the crop, in scenes of models without a background."""


class Segmenter:
    """Segments and tracks the objects of videos of any size.

    Frames are cropped in the middle to the shape of the model's input, or put whole between black bars, and resized.
    Scenes come back in the pixels of the frames that were given.

    Args:
        predictor: the model.
        input_size: (h, w) of what the model sees.
        fit: "crop" or "letterbox".
        full_size: scenes have the size of the frames; False: that of the model's input, which takes less memory.
        detail: fill `Scene.windows` and `Scene.means` too.
    """

    def __init__(
        self,
        predictor: Predictor,
        input_size: tuple[int, int],
        fit: Fit = "crop",
        full_size: bool = True,
        detail: bool = False,
    ) -> None:
        if fit not in ("crop", "letterbox"):
            raise UserError(f"fit = {fit!r} is wrong: give 'crop' or 'letterbox'.")
        self.predictor, self.input_size = predictor, input_size
        self.fit: Fit = fit
        self.full_size, self.detail = full_size, detail

    @property
    def tracks(self) -> bool:
        """Identities continue from frame to frame; False for models of single images."""
        return self.predictor.model.tracks

    @property
    def streams(self) -> bool:
        """Videos can be processed chunk by chunk (`stream`)."""
        return self.predictor.model.streams

    def framing(self, size: tuple[int, int]) -> Framing:
        """What of frames of (H, W) pixels the model sees."""
        return framing(size, self.input_size, self.fit)

    def __call__(self, frames: np.ndarray | Tensor, name: str = "video") -> Scene:
        """The scene of a whole video (B = 1).

        Args:
            frames: (T, H, W, 3) uint8 RGB, NumPy or PyTorch, T > 0.
            name: of the video; models that sample in evaluation draw from it.

        Returns:
            Masks and reconstruction are (1, T, K, H, W) and (1, T, 3, H, W). What lies outside the crop belongs to the
            background, in models without one to a further component with the identity `NOTHING_SEEN`; the
            reconstruction is black there.

        Raises:
            UserError: frames of another type or shape.
        """
        images = _video(frames)
        view = self.framing((images.shape[1], images.shape[2]))
        scene = self.scene_of(np.stack([view.fitted(image) for image in images]), name)
        return self._returned(scene, view)

    def stream(self, frames: Iterable[np.ndarray | Tensor], chunk: int = 16, name: str = "video") -> Iterator[Scene]:
        """The scenes of consecutive chunks of a video; identities continue, and memory does not grow.

        Args:
            frames: (H, W, 3) uint8 RGB each, all of one size; there may be any number.
            chunk: frames of a scene; the last may have fewer.
            name: as in a call.

        Raises:
            UserError: a model that needs whole videos, or a frame of another type, shape or size.
        """
        if not self.streams:
            raise UserError(
                f"{type(self.predictor.model).__name__} needs the whole video at once: "
                "call segmenter(frames) instead of segmenter.stream(frames)."
            )
        if chunk < 1:
            raise UserError(f"chunk = {chunk} is wrong: give at least 1.")
        return self._streamed(frames, chunk, name)

    def _streamed(self, frames: Iterable[np.ndarray | Tensor], chunk: int, name: str) -> Iterator[Scene]:
        view: Framing | None = None
        waiting: list[np.ndarray] = []
        done, state = 0, None

        def scene(framed: Framing) -> Scene:
            return self.scene_of(np.stack(waiting), name, done, state)

        for frame in frames:
            image = _image(frame)
            if view is None:
                view = self.framing(image.shape[:2])
            if image.shape[:2] != view.frame:
                raise UserError(
                    f"frame {done + len(waiting)} is {image.shape[:2]}, the first {view.frame}: give one size."
                )
            waiting.append(view.fitted(image))
            if len(waiting) == chunk:
                found = scene(view)
                done, state, waiting = done + chunk, found.state, []
                yield self._returned(found, view)
        if waiting and view is not None:
            yield self._returned(scene(view), view)

    @torch.no_grad()
    def scene_of(
        self, images: UInt8[np.ndarray, "T h w 3"], name: str = "video", first_frame: int = 0, state: Any = None
    ) -> Scene:
        """The scene of consecutive frames that have the model's input size already; its masks have that size too.

        Args:
            images: RGB.
            name: of the video.
            first_frame: number of the first of these frames in its video.
            state: `Scene.state` of the frames before.
        """
        predictor = self.predictor
        predictor.model.eval()
        video = as_float(torch.from_numpy(images).to(predictor.device).permute(0, 3, 1, 2))[None]
        return predictor.chunk_of(video.contiguous(), [name], first_frame, state, self.detail)

    def _returned(self, scene: Scene, view: Framing) -> Scene:
        return in_frame(scene, view) if self.full_size else scene


def in_frame(scene: Scene, view: Framing) -> Scene:
    """A scene at the model's input size -> the scene in the pixels of the frame."""
    part, whole = view.source, view.frame
    masks = resize_masks(view.of_target(scene.masks), (part.height, part.width))
    canvas = masks.new_zeros(*masks.shape[:3], *whole)
    canvas[(..., *part.slices)] = masks
    found = dataclasses.replace(
        scene,
        masks=canvas,
        reconstruction=_placed(scene.reconstruction, view),
        means=None if scene.means is None else _placed(scene.means, view),
        windows=None if scene.windows is None else _windows(scene.windows, view),
    )
    if (part.height, part.width) == whole:
        return found
    outside = torch.ones(whole, dtype=torch.bool, device=masks.device)
    outside[part.slices] = False
    if not bool(scene.background.any()):
        found = _with_nothing_seen(found)
    background = int(found.background.int().argmax())
    found.masks[:, :, background, outside] = 1.0
    return found


def _with_nothing_seen(scene: Scene) -> Scene:
    """The scene with a further background component, which has no pixel yet."""

    def more(tensor: Tensor, value: float) -> Tensor:
        return torch.cat([tensor, torch.full_like(tensor[:, :, :1], value)], dim=2)

    return dataclasses.replace(
        scene,
        masks=more(scene.masks, 0.0),
        background=torch.cat([scene.background, torch.ones_like(scene.background[:1])]),
        ids=more(scene.ids, NOTHING_SEEN),
        presence=more(scene.presence, 1.0),
        appearance=more(scene.appearance, 0.0),
        windows=None if scene.windows is None else more(scene.windows, torch.nan),
        means=None if scene.means is None else more(scene.means, 0.0),
    )


def _placed(images: Float[Tensor, "*batch 3 h w"], view: Framing) -> Float[Tensor, "*batch 3 H W"]:
    part = resized_images(view.of_target(images), (view.source.height, view.source.width))
    canvas = part.new_zeros(*part.shape[:-2], *view.frame)
    canvas[(..., *view.source.slices)] = part
    return canvas


def _windows(windows: Float[Tensor, "B T K 4"], view: Framing) -> Float[Tensor, "B T K 4"]:
    """Windows (s_y, s_x, t_y, t_x) of the model's input -> of the frame."""

    def axis(size: Tensor, centre: Tensor, place: int) -> tuple[Tensor, Tensor]:
        target = (view.target.top, view.target.height), (view.target.left, view.target.width)
        source = (view.source.top, view.source.height), (view.source.left, view.source.width)
        scale = source[place][1] / target[place][1]
        pixel = ((centre + 1) / 2 * view.input[place] - target[place][0]) * scale + source[place][0]
        return size * view.input[place] * scale / view.frame[place], pixel / view.frame[place] * 2 - 1

    s_y, s_x, t_y, t_x = windows.unbind(-1)
    (s_y, t_y), (s_x, t_x) = axis(s_y, t_y, 0), axis(s_x, t_x, 1)
    return torch.stack([s_y, s_x, t_y, t_x], dim=-1)


def _video(frames: object) -> UInt8[np.ndarray, "T H W 3"]:
    array = _array(frames)
    if array.ndim != 4 or array.shape[3] != 3 or 0 in array.shape:
        raise UserError(
            f"frames have the shape {tuple(array.shape)}: give (T, H, W, 3), RGB in the last place, none of it 0."
        )
    return _bytes(array)


def _image(frame: object) -> UInt8[np.ndarray, "H W 3"]:
    array = _array(frame)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise UserError(
            f"a frame has the shape {tuple(array.shape)}: give (H, W, 3), RGB in the last place, none of it 0."
        )
    return _bytes(array)


def _array(frames: object) -> np.ndarray:
    if isinstance(frames, Tensor):
        return frames.detach().cpu().numpy()
    if isinstance(frames, np.ndarray):
        return frames
    raise UserError(f"frames are a {type(frames).__name__}: give a NumPy array or a PyTorch tensor of uint8.")


def _bytes(array: np.ndarray) -> np.ndarray:
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise UserError(f"frames are {array.dtype} and hold NaN or infinity: give uint8, 0 to 255.")
    raise UserError(f"frames are {array.dtype}: give uint8, 0 to 255.")

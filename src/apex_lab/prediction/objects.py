"""From a scene at the model's size to the objects of each frame, in the frame's own pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int16, Int64, UInt8
from torch import Tensor

from apex_lab.inference.state import Leaf, leaves
from apex_lab.metrics.linking import Linker
from apex_lab.scene import ABSENT, Scene
from apex_lab.videos import Frame, Framing
from apex_lab.view.annotated import UNSEEN

_UNSEEN, _NOTHING = -1, -2
"""In place of a component: outside the crop; seen, and no component is there."""


@dataclass(frozen=True)
class Seen:
    """An object in a frame.

    Attributes:
        id: 1, 2, ... in order of appearance in the video.
        index: its value in `Predicted.index`, unique in the frame.
        presence: in [0, 1].
        area: pixels.
        box: left, top, width, height in pixels; None where it has no pixel (hidden by others).
        centre: mean x and y of its pixels, those of the top left pixel being 0; None as `box`.
    """

    id: int
    index: int
    presence: float
    area: int
    box: tuple[int, int, int, int] | None
    centre: tuple[float, float] | None


@dataclass(frozen=True)
class Predicted:
    """The objects of one frame.

    Attributes:
        number: of the frame in its video, from 0.
        frame: image and time.
        index: (H, W) 0 background, `Seen.index` of an object, `UNSEEN` outside the crop.
        objects: those that are present.
        appearance: their vectors.
    """

    number: int
    frame: Frame
    index: UInt8[np.ndarray, "H W"]
    objects: Sequence[Seen]
    appearance: Float[np.ndarray, "N A"]


class Names:
    """Ids of objects in order of appearance, and the index of each in pictures that have room for 254.

    An object keeps its index. Once 254 are given, a new object takes over that of the one not seen for the longest
    time, so an index is unique in each frame, while the id is unique in the video.
    """

    def __init__(self) -> None:
        self.ids: dict[int, int] = {}
        self._indices: dict[int, int] = {}  # id -> index, the one seen last at the end

    @property
    def reused(self) -> bool:
        """Some index has stood for several objects."""
        return len(self.ids) >= UNSEEN

    def __call__(self, identities: Sequence[int]) -> list[tuple[int, int]]:
        """(id, index) of the objects of the next frame, at most 254.

        Args:
            identities: the model's, each once.
        """
        ids = [self.ids.setdefault(identity, len(self.ids) + 1) for identity in identities]
        for known in [each for each in ids if each in self._indices]:
            self._indices[known] = self._indices.pop(known)
        for new in [each for each in ids if each not in self._indices]:
            free = len(self._indices) + 1
            self._indices[new] = free if free < UNSEEN else self._indices.pop(next(iter(self._indices)))
        return [(each, self._indices[each]) for each in ids]

    def stored(self) -> dict[str, Any]:
        """Plain values for a file."""
        return {"ids": [list(pair) for pair in self.ids.items()], "indices": [list(p) for p in self._indices.items()]}

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Names:
        """The inverse of `stored`."""
        names = cls()
        names.ids = {int(identity): int(each) for identity, each in stored["ids"]}
        names._indices = {int(each): int(index) for each, index in stored["indices"]}
        return names


class Reader:
    """Reads the objects of consecutive frames out of scenes.

    Args:
        view: what of the frames the model sees.
        tracks: the model's identities continue over time; else objects are linked by the overlap of their masks.
        min_presence: objects below it are absent.
    """

    def __init__(self, view: Framing, tracks: bool, min_presence: float) -> None:
        self.view, self.min_presence = view, min_presence
        self.names = Names()
        self.linker = None if tracks else Linker()

    def __call__(self, scene: Scene, t: int, number: int, frame: Frame) -> Predicted:
        """The objects of one frame.

        Args:
            scene: at the model's input size, B = 1.
            t: which frame of the scene.
            number: of the frame in its video.
            frame: that frame.
        """
        masks = scene.masks[0, t].float().cpu().numpy()
        presence = scene.presence[0, t].float().cpu().numpy()
        ids, background = scene.ids[0, t].cpu().numpy().copy(), scene.background.cpu().numpy()
        there = (ids != ABSENT) & (background | (presence >= self.min_presence))
        if self.linker is not None:
            ids = self._linked(self.linker, masks, there, background)
            there = there & (ids != ABSENT)
        winner = label_map(masks, there, self.view)
        components = np.flatnonzero(there & ~background)
        named = self.names([int(ids[k]) for k in components])
        index = np.zeros(len(masks) + 2, dtype=np.uint8)  # the last two places are those of -2 and -1
        index[_UNSEEN] = UNSEEN
        objects = []
        for k, (each, place) in zip(components, named, strict=True):
            index[k] = place
            objects.append(_seen(each, place, float(presence[k]), winner == k))
        appearance = scene.appearance[0, t].float().cpu().numpy()[components]
        return Predicted(number, frame, index[winner], objects, appearance)

    def stored(self) -> dict[str, Any]:
        """Plain values from which the next frame is read; `tensors` holds the rest."""
        linked = self.linker is not None and self.linker.last is not None
        used = 0 if self.linker is None else self.linker.used
        return {"names": self.names.stored(), "linked": linked, "used": used}

    def tensors(self) -> list[Leaf]:
        """The last frame of linked objects."""
        if self.linker is None or self.linker.last is None:
            return []
        return leaves(self.linker.last)

    def restore(self, stored: Mapping[str, Any], tensors: Sequence[Leaf]) -> list[Leaf]:
        """The inverse of `stored` and `tensors`.

        Args:
            stored: plain values.
            tensors: of the reader, and more.

        Returns:
            The tensors that are not of the reader.
        """
        self.names = Names.of(stored["names"])
        if self.linker is None or not stored["linked"]:
            return list(tensors)
        self.linker.used = int(stored["used"])
        labels, ignored = (tensor.numpy() for tensor in tensors[:2] if isinstance(tensor, Tensor))
        self.linker.last = (labels, ignored)
        return list(tensors[2:])

    def _linked(
        self,
        linker: Linker,
        masks: Float[np.ndarray, "K h w"],
        there: Bool[np.ndarray, " K"],
        background: Bool[np.ndarray, " K"],
    ) -> Int64[np.ndarray, " K"]:
        """Identities that continue from the frame before; `ABSENT` for components that win no pixel."""
        seen = self.view.of_target(masks)
        winner = np.where(there[:, None, None], seen, -1.0).argmax(axis=0)
        ids = np.full(len(masks), ABSENT, dtype=np.int64)
        ids[background] = 0
        if not there.any():
            return ids
        of_object = ~background[winner]
        linked = linker(winner, ~of_object)
        ids[winner[of_object]] = linked[of_object]
        return ids


def label_map(
    masks: Float[np.ndarray, "K h w"], there: Bool[np.ndarray, " K"], view: Framing
) -> Int16[np.ndarray, "H W"]:
    """The component that wins each pixel of the frame; -1 outside the crop, -2 where no component is there.

    Soft masks are resized bilinearly, one after the other, so that large frames need little memory. Ties go to the
    lowest component.
    """
    size = view.source.height, view.source.width
    best = np.full(size, -1.0, dtype=np.float32)
    winner = np.full(size, _NOTHING, dtype=np.int16)
    for k in np.flatnonzero(there):
        mask = np.ascontiguousarray(view.of_target(masks[k]))
        values = mask if mask.shape == size else cv2.resize(mask, size[::-1], interpolation=cv2.INTER_LINEAR)
        better = values > best
        winner[better] = k
        np.copyto(best, values, where=better)
    if size == view.frame:
        return winner
    whole = np.full(view.frame, _UNSEEN, dtype=np.int16)
    whole[view.source.slices] = winner
    return whole


def _seen(each: int, index: int, presence: float, pixels: Bool[np.ndarray, "H W"]) -> Seen:
    area = int(np.count_nonzero(pixels))
    if not area:
        return Seen(each, index, presence, 0, None, None)
    moments = cv2.moments(pixels.view(np.uint8), binaryImage=True)
    left, top, width, height = cv2.boundingRect(pixels.view(np.uint8))
    return Seen(
        *(each, index, presence, area),
        (left, top, width, height),
        (moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]),
    )

"""Where does a model fail? Results per object and video, and their means by class, size, occlusion and contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int64, Integer

from apex_lab.metrics.boundary import BoundaryScores
from apex_lab.metrics.overlap import best_overlaps
from apex_lab.metrics.tracking import Detections, Events

P2D_ARM_LABEL = 1
P2D_FIRST_OBJECT_LABEL = 2


@dataclass(frozen=True)
class ObjectMetadata:
    """What is known of the L true objects of one video beside their masks.

    Attributes:
        labels: their labels in the segmentation.
        classes: their class names.
        occlusion: hidden share in [0, 1] per frame, NaN where nothing would be seen anyway; None if unknown.
        contact: whether the object touched another one (or the arm) since the frame before; None if unknown.
    """

    labels: Integer[np.ndarray, " L"]
    classes: Sequence[str]
    occlusion: Float[np.ndarray, "T L"] | None = None
    contact: Bool[np.ndarray, "T L"] | None = None


def p2d_metadata(meta: Mapping[str, Any]) -> ObjectMetadata:
    """From the labels that P2D keeps beside each video, as `P2D.meta` returns them.

    Args:
        meta: `names`, class names of the used object slots; `classes` (O,), negative for an unused slot; `visible_px`
            and `amodal_px` (T, O + 1), the arm first; `arm_contact` (T, O); `object_contact` (T, O, O).
    """
    used = np.flatnonzero(meta["classes"] >= 0)
    occlusion = 1 - meta["visible_px"] / np.where(meta["amodal_px"] > 0, meta["amodal_px"], np.nan)
    of_objects = meta["arm_contact"] | meta["object_contact"].any(axis=2)
    contact = np.column_stack([meta["arm_contact"].any(axis=1), of_objects])
    columns = np.append(0, used + 1)
    return ObjectMetadata(
        labels=np.append(P2D_ARM_LABEL, used + P2D_FIRST_OBJECT_LABEL),
        classes=["arm", *meta["names"]],
        occlusion=occlusion[:, columns],
        contact=contact[:, columns],
    )


def object_rows(
    counts: Int64[np.ndarray, "T G P"],
    labels: Int64[np.ndarray, " G"],
    metadata: ObjectMetadata | None = None,
    boundary: BoundaryScores | None = None,
    frames: Sequence[Detections] = (),
    events: Events | None = None,
    pixels: int | None = None,
) -> pd.DataFrame:
    """One row per true object of one video.

    Args:
        counts: the video's contingency table.
        labels: the label of each row of it.
        metadata: class, occlusion, contact; NaN (class: None) where missing.
        boundary: J and F per object; NaN where missing.
        frames, events: tracking; NaN where missing: there are no identities over time.
        pixels: of an image; as many as the table counts where missing.

    Returns:
        columns `label`, `class`, `frames` (in which it is visible), `area_px` (mean where visible), `size` (the same
        as a share of the image), `occlusion` (mean hidden share where visible), `contact` (share of the visible
        frames), `best_iou` (mean over the visible frames of the best IoU with any predicted mask), `video_iou` (the
        same on space-time volumes), `j`, `f`, `occurrences` (frames evaluated by tracking), `detected` and `tracked`
        (shares of those with a match at all, and without a switch), `switches`.
    """
    area = counts[:, 1:].sum(axis=2)
    seen = area > 0
    found = {
        "label": labels[1:],
        "frames": seen.sum(axis=0),
        "area_px": _mean_where(area, seen),
        "size": _mean_where(area / (pixels or counts[0].sum()), seen),
        "best_iou": _mean_where(best_overlaps(counts), seen),
        "video_iou": best_overlaps(counts.sum(axis=0)) if events else np.nan,
        "j": np.nanmean(boundary.j, axis=1) if boundary else np.nan,
        "f": np.nanmean(boundary.f, axis=1) if boundary else np.nan,
    }
    table = pd.DataFrame(
        found | _metadata_columns(labels[1:], seen, metadata) | _tracking_columns(frames, events, labels)
    )
    return table[list(COLUMNS)]


COLUMNS = (
    *("label", "class", "frames", "area_px", "size", "occlusion", "contact", "best_iou", "video_iou", "j", "f"),
    *("occurrences", "detected", "tracked", "switches"),
)
"""Columns of `object_rows`; the evaluator puts `video` before them."""

_OUTCOMES = ["best_iou", "video_iou", "j", "f", "detected", "tracked", "switches"]


def by_property(objects: pd.DataFrame, bins: int = 4) -> pd.DataFrame:
    """Mean results of groups of objects alike in class, size, occlusion or contact.

    Args:
        objects: rows of `object_rows` of any number of videos.
        bins: groups of about equal number for the properties that are numbers (fewer where values repeat).

    Returns:
        columns `property`, `group` (class name or interval), `objects` (how many) and the means of the results over
        the group's objects, each object one vote.
    """
    parts = []
    for name in ("class", "size", "occlusion", "contact"):
        known = objects[objects[name].notna()]
        if known.empty:
            continue
        group = known[name] if name == "class" else _intervals(known[name].astype(float), bins)
        grouped = known.groupby(group.rename("group"), observed=True)
        part = grouped[_OUTCOMES].mean()
        part.insert(0, "objects", grouped.size())
        part = part.reset_index()
        part.insert(0, "property", name)
        parts.append(part.astype({"group": str}))
    columns = ["property", "group", "objects", *_OUTCOMES]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def _intervals(values: pd.Series, bins: int) -> pd.Series:
    """The interval of about equally filled ones that each value lies in."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    if len(edges) == 1:
        return pd.Series(f"{edges[0]:g}", index=values.index)
    return pd.cut(values, edges.tolist(), include_lowest=True)


def _metadata_columns(
    labels: Int64[np.ndarray, " O"], seen: Bool[np.ndarray, "T O"], metadata: ObjectMetadata | None
) -> dict[str, object]:
    if metadata is None:
        return {"class": None, "occlusion": np.nan, "contact": np.nan}
    for name in ("occlusion", "contact"):
        values, wanted = getattr(metadata, name), (len(seen), len(metadata.labels))
        if values is not None and values.shape != wanted:
            raise ValueError(f"{name} of the metadata has shape {values.shape}; want (frames, labels) = {wanted}")
    place = {int(label): i for i, label in enumerate(metadata.labels)}
    known = [place.get(int(label)) for label in labels]

    def mean(values: np.ndarray | None) -> list[float]:
        return [
            np.nan if values is None or i is None else _mean_where(values[:, [i]].astype(float), seen[:, [o]])[0]
            for o, i in enumerate(known)
        ]

    classes = [None if i is None else metadata.classes[i] for i in known]
    return {"class": classes, "occlusion": mean(metadata.occlusion), "contact": mean(metadata.contact)}


def _tracking_columns(
    frames: Sequence[Detections], events: Events | None, labels: Int64[np.ndarray, " G"]
) -> dict[str, object]:
    if events is None:
        return dict.fromkeys(("occurrences", "detected", "tracked", "switches"), np.nan)

    def per_object(rows: np.ndarray) -> Int64[np.ndarray, " O"]:
        return np.bincount(rows, minlength=len(labels))[1:]

    occurrences = per_object(np.concatenate([np.empty(0, dtype=np.int64), *(f.rows for f in frames)]))
    matches, switches = (per_object(events.row[events.of(name)]) for name in ("MATCH", "SWITCH"))
    whole = np.where(occurrences > 0, occurrences, np.nan)
    return {
        "occurrences": occurrences,
        "detected": (matches + switches) / whole,
        "tracked": matches / whole,
        "switches": switches,
    }


def _mean_where(values: np.ndarray, where: Bool[np.ndarray, "T O"]) -> Float[np.ndarray, " O"]:
    """Mean over the chosen frames, NaN values left out; NaN where no frame is left."""
    where = where & ~np.isnan(values)
    count = where.sum(axis=0)
    return np.where(where, values, 0).sum(axis=0) / np.where(count > 0, count, np.nan)

"""Figures of the data card: samples of every class, film strips with masks, histograms."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from PIL import Image, ImageDraw, ImageFont

from sims.p2d.stats import MOVED_M, Stats
from sims.p2d.trajectory import ARM_ID, FIRST_OBJECT_ID

TILE = 128
GAP = 4
PAPER = (255, 255, 255)
INK = (30, 30, 30)
COLOURS = np.array(
    [(0, 0, 0), (255, 200, 0), (0, 150, 255), (235, 40, 130), (60, 190, 80), (150, 90, 220), (255, 120, 40)], np.uint8
)
"""By id; further ids cycle through all but the background's."""


def colour_of(identity: np.ndarray) -> np.ndarray:
    """Ids (...) -> RGB (..., 3) uint8."""
    return COLOURS[np.where(identity > 0, (identity.astype(int) - 1) % (len(COLOURS) - 1) + 1, 0)]


def overlay(rgb: np.ndarray, segmentation: np.ndarray) -> np.ndarray:
    """(H, W, 3) image: foreground tinted by id with a solid outline, background faded."""
    inner = segmentation.copy()
    for axis in (0, 1):
        for shift in (1, -1):
            inner = np.where(np.roll(segmentation, shift, axis) == segmentation, inner, 0)
    grey = rgb.astype(float).mean(axis=2, keepdims=True)
    tinted = colour_of(segmentation) * (0.5 + 0.5 * grey / 255)
    picture = np.where((segmentation > 0)[..., None], tinted, grey * 0.5 + 100)
    outline = (segmentation > 0) & (inner == 0)
    return np.where(outline[..., None], colour_of(segmentation), picture).astype(np.uint8)


def strips(videos: list[tuple[str, np.ndarray, np.ndarray]], columns: int = 8) -> Image.Image:
    """Film strips: per video a row of frames, and below it the same frames with masks.

    Args:
        videos: title, rgb (T, H, W, 3), segmentation (T, H, W).
        columns: frames shown, evenly spaced.
    """
    head = 18
    frames = np.linspace(0, len(videos[0][1]) - 1, min(columns, len(videos[0][1]))).round().astype(int)
    high = head + 2 * TILE + 3 * GAP
    page = Image.new("RGB", (GAP + len(frames) * (TILE + GAP), len(videos) * high), PAPER)
    draw = ImageDraw.Draw(page)
    for row, (title, rgb, segmentation) in enumerate(videos):
        top = row * high
        draw.text((GAP, top + 2), title, INK, _font(12))
        for column, frame in enumerate(frames):
            left = GAP + column * (TILE + GAP)
            page.paste(_tile(rgb[frame]), (left, top + head))
            page.paste(_tile(overlay(rgb[frame], segmentation[frame])), (left, top + head + TILE + GAP))
    return page


def samples(names: list[str], crops: list[list[np.ndarray]], columns: int = 6) -> Image.Image:
    """A row of crops (S, S, 3) per class, two classes side by side."""
    label, wide = 124, columns * (TILE + GAP)
    rows = -(-len(names) // 2)
    page = Image.new("RGB", (2 * (label + wide) + GAP, rows * (TILE + GAP) + GAP), PAPER)
    draw = ImageDraw.Draw(page)
    for number, (name, found) in enumerate(zip(names, crops, strict=True)):
        left, top = (number // rows) * (label + wide), GAP + (number % rows) * (TILE + GAP)
        draw.text(
            (left + label - 8, top + TILE // 2), name.replace("_", "\n"), INK, _font(13), anchor="rm", align="right"
        )
        for column, crop in enumerate(found[:columns]):
            page.paste(_tile(crop), (left + label + column * (TILE + GAP), top))
    return page


def histograms(path: Path, stats: Stats, names: list[str]) -> None:
    """Writes one PNG with a panel per quantity."""
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axes = plt.subplots(2, 4, figsize=(16, 7), layout="constrained")
        _counts(axes[0, 0], stats.objects, "objects per scene", "trajectories")
        _counts(axes[0, 1], stats.visible.ravel(), "visible per frame, with arm", "frames")
        _area(axes[0, 2], stats)
        _occlusion(axes[0, 3], stats)
        _speed(axes[1, 0], stats)
        _moved(axes[1, 1], stats)
        _contact(axes[1, 2], stats)
        _balance(axes[1, 3], stats, names)
        figure.savefig(path, dpi=80)
        plt.close(figure)


ARM, OBJECT, BAR = "#d99a00", "#0072b2", "#5a7d9a"


def _bins(top: float) -> list[float]:
    return [float(edge) for edge in np.linspace(0, top, 41)]


def _counts(axes: Axes, values: np.ndarray, title: str, what: str) -> None:
    found, counts = np.unique(values, return_counts=True)
    bars = axes.bar(found, counts / max(counts.sum(), 1), color=BAR, width=0.7)
    axes.bar_label(bars, fmt="{:.0%}")
    axes.set(title=f"{title} (mean {values.mean():.2f})", ylabel=f"share of {what}", xticks=found)


def _area(axes: Axes, stats: Stats) -> None:
    shares = stats.area[np.isfinite(stats.area)] * 100
    top = float(np.percentile(shares, 99.5)) if shares.size else 1.0
    for part, name, colour in ((stats.area[..., 1:], "objects", OBJECT), (stats.area[..., :1], "arm", ARM)):
        values = part[np.isfinite(part)] * 100
        if values.size:
            label = f"{name} (mean {values.mean():.1f} %)"
            axes.hist(np.clip(values, 0, top), _bins(top), density=True, alpha=0.65, color=colour, label=label)
    axes.axvline(6, color="black", linestyle=":", label="published mean, all: 6 %")
    axes.set(title="mask area", xlabel="% of the image, where visible", ylabel="density")
    axes.legend(frameon=False)


def _occlusion(axes: Axes, stats: Stats) -> None:
    values = stats.occlusion[..., 1:]
    values = values[np.isfinite(values)]
    share = (values > 0.01).mean() if values.size else 0.0
    axes.hist(values[values > 0.01], _bins(1), color=OBJECT)
    title = f"occlusion of objects ({share:.0%} not free)"
    axes.set(title=title, xlabel="hidden share, where > 1 %", ylabel="object-frames")


def _speed(axes: Axes, stats: Stats) -> None:
    values = stats.step_m[np.isfinite(stats.step_m)] * 1000
    moving = values[values > 0.5]
    share = moving.size / max(values.size, 1)
    top = max(float(np.percentile(moving, 99.5)), 1.0) if moving.size else 1.0
    axes.hist(np.clip(moving, 0, top), _bins(top), color=OBJECT)
    axes.set(title=f"speed of objects ({share:.0%} moving)", xlabel="mm per frame, where > 0.5", ylabel="object-steps")


def _moved(axes: Axes, stats: Stats) -> None:
    farthest = np.nan_to_num(stats.moved_m).max(axis=1) * 100
    axes.hist(farthest, _bins(max(float(farthest.max(initial=0)), 1)), color=BAR)
    axes.axvline(MOVED_M * 100, color="black", linestyle=":", label=f"{MOVED_M * 100:.0f} cm")
    axes.set(title="farthest move of any object", xlabel="cm", ylabel="trajectories")
    axes.legend(frameon=False)


def _contact(axes: Axes, stats: Stats) -> None:
    rows = {
        "line aimed\nat an object": stats.aimed,
        "objects touch\neach other": stats.collided,
        f"… and moves it\n≥ {MOVED_M * 100:.0f} cm": stats.pushed,
        "arm touches\nan object": stats.touched,
    }
    bars = axes.barh(list(rows), [float(flags.mean()) for flags in rows.values()], color=BAR, height=0.6)
    axes.bar_label(bars, fmt="{:.0%}", padding=2)
    axes.set(title="contact", xlabel="share of trajectories", xlim=(0, 1.1))


def _balance(axes: Axes, stats: Stats, names: list[str]) -> None:
    counts = np.bincount(stats.classes[stats.classes >= 0], minlength=len(names))
    bars = axes.barh(names[::-1], counts[::-1], color=BAR)
    axes.bar_label(bars, padding=2)
    axes.set(title="class balance", xlabel="trajectories with it")


def crops_of(rgb: np.ndarray, segmentation: np.ndarray, identity: int) -> np.ndarray | None:
    """A square crop of one frame around one id, with a margin; None if the id is absent."""
    rows, columns = np.nonzero(segmentation == identity)
    if rows.size == 0:
        return None
    side = int(1.35 * max(np.ptp(rows), np.ptp(columns))) + 4
    side = min(side, segmentation.shape[0])
    corner = [
        int(np.clip((low + high - side) // 2, 0, segmentation.shape[0] - side))
        for low, high in ((rows.min(), rows.max()), (columns.min(), columns.max()))
    ]
    return rgb[corner[0] : corner[0] + side, corner[1] : corner[1] + side]


def object_identity(slot: int) -> int:
    """Id of an object slot in a segmentation."""
    return FIRST_OBJECT_ID + slot


def legend(slots: list[str]) -> str:
    """Ids and names in one video, for a strip's title."""
    return ", ".join([f"{ARM_ID} arm", *(f"{object_identity(slot)} {name}" for slot, name in enumerate(slots))])


def _tile(picture: np.ndarray) -> Image.Image:
    image = Image.fromarray(np.ascontiguousarray(picture))
    larger = picture.shape[0] >= TILE
    return image.resize((TILE, TILE), Image.Resampling.LANCZOS if larger else Image.Resampling.BICUBIC)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)

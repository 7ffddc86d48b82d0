"""The data card: a Markdown page with samples and statistics of a P2D folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.files import no_room, write_at_once
from recordings.layout import array_path
from sims.errors import SimError
from sims.p2d import draw
from sims.p2d.stats import MOVED_M, PUBLISHED, Stats, statistics
from sims.p2d.store import SPLITS, Manifest, check

STRIPS = 10
SAMPLES = 6
QUALITY = 82
PAGE = "README.md"


def write_card(root: Path, out: Path) -> Path:
    """Writes `samples.jpg`, `strips.jpg`, `histograms.png` and, last, `README.md`; returns the page's path.

    Raises:
        SimError: the folder is not finished or is damaged, or holds no trajectory, or the disk is full.
    """
    manifest = check(root)
    splits = [split for split in SPLITS if getattr(manifest.settings, split)]
    if not splits:
        raise SimError(f"{root} holds no trajectory, so it has no data card")
    stats = statistics(root, manifest, splits)
    page = out / PAGE
    try:
        out.mkdir(parents=True, exist_ok=True)
        # JPEG keeps the page small enough for version control.
        samples = draw.samples(manifest.facts["classes"], _crops(root, manifest, splits[0]))
        samples.save(out / "samples.jpg", quality=QUALITY, subsampling=0)
        draw.strips(_strips(root, manifest, splits[-1])).save(out / "strips.jpg", quality=QUALITY, subsampling=0)
        draw.histograms(out / "histograms.png", stats, manifest.facts["classes"])
        write_at_once(page, _page(manifest, stats, splits))
    except OSError as error:
        raise no_room(error, error.filename or out) from error
    return page


def _arrays(root: Path, split: str) -> tuple[np.ndarray, ...]:
    names = ("rgb", "segmentation", "classes", "visible_px", "amodal_px", "arm_contact")
    return tuple(np.load(array_path(root, split, name), mmap_mode="r", allow_pickle=False) for name in names)


def _crops(root: Path, manifest: Manifest, split: str) -> list[list[np.ndarray]]:
    """Per class, the least occluded views, from different trajectories."""
    rgb, segmentation, classes, visible, amodal, _ = _arrays(root, split)
    share = visible[..., 1:] / np.maximum(amodal[..., 1:], 1)
    found: list[list[np.ndarray]] = []
    for number in range(len(manifest.facts["classes"])):
        crops: list[np.ndarray] = []
        for index, slot in zip(*np.nonzero(classes == number), strict=True):
            frame = int(share[index, :, slot].argmax())
            crop = draw.crops_of(rgb[index, frame], segmentation[index, frame], draw.object_identity(int(slot)))
            if crop is not None and share[index, frame, slot] > 0.8:
                crops.append(np.array(crop))
            if len(crops) == SAMPLES:
                break
        found.append(crops)
    return found


def _strips(root: Path, manifest: Manifest, split: str) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """The first trajectories of a split."""
    rgb, segmentation, classes, *_ = _arrays(root, split)
    videos = []
    for index in range(min(STRIPS, len(rgb))):
        names = [manifest.facts["classes"][number] for number in classes[index] if number >= 0]
        videos.append((f"{split}/{index}: {draw.legend(names)}", np.array(rgb[index]), np.array(segmentation[index])))
    return videos


def _page(manifest: Manifest, stats: Stats, splits: list[str]) -> str:
    settings = manifest.settings
    counts = ", ".join(f"{getattr(settings, split):,} {split}" for split in splits)
    command = f"{stats.visible.size:,} frames of {settings.image_size} × {settings.image_size} pixels"
    versions = ", ".join(f"{name} {version}" for name, version in manifest.facts["versions"].items())
    return f"""# Data card: P2D (re-creation)

A simulated Panda arm moves along random straight lines over a table and pushes household objects. A re-creation of the
Panda Pushing Dataset of the APEX paper, which was never released, from its description; all numbers are of the
re-creation.

| | |
|---|---|
| trajectories | {counts}; {settings.frames} frames each |
| size | {command}, {manifest.layout.total_bytes() / 1e9:.2f} GB |
| objects per scene | {settings.min_objects} to {settings.max_objects} of {len(settings.objects)} classes |
| renderer | `{settings.renderer}` |
| seed | {settings.seed} |
| fingerprint, content | `{manifest.fingerprint}`, `{manifest.content}` |
| versions | {versions} |

## Calibration

{_calibration(stats)}

Published: the scores of the collapsed models in the paper's ablation table, which depend on the data alone.
The number of objects is uniform (the paper states no distribution): if all are visible,
{(settings.min_objects + settings.max_objects) / 2 + 1:.1f} per frame, including the arm.

| | |
|---|---|
{_numbers(stats)}

## Classes

![samples of every class](samples.jpg)

{_classes(manifest, stats)}

## Film strips

The first trajectories of the {splits[-1]} split. Below each frame its masks: the arm yellow, objects by slot.

![film strips with masks](strips.jpg)

## Histograms

![histograms](histograms.png)
"""


def _calibration(stats: Stats) -> str:
    rows = {
        "visible_per_frame": "visible objects per frame, including the arm",
        "one_segment_msc": "MSC of a single segment: mean of 1 / (visible + 1)",
        "one_segment_msc_fg": "MSC-FG of a single segment: mean area share of the visible objects",
    }
    lines = ["| | here | published |", "|---|---|---|"]
    lines += [f"| {text} | {getattr(stats, key):.3f} | {PUBLISHED[key]} |" for key, text in rows.items()]
    return "\n".join(lines)


def _numbers(stats: Stats) -> str:
    objects, arm = stats.area[..., 1:], stats.area[..., 0]
    used = np.isfinite(stats.moved_m)[:, None, :].repeat(stats.area.shape[1], axis=1)
    seen = np.isfinite(objects)
    hidden = stats.occlusion[..., 1:]
    tries = stats.redraws.sum() + len(stats.redraws)
    rows = {
        "area of a visible object": f"{_share(objects)} of the image",
        "area of the arm where visible": f"{_share(arm)} of the image",
        "frames that show the arm": f"{np.isfinite(arm).mean():.1%}",
        "object-frames with the object invisible": f"{(used & ~seen).sum() / max(used.sum(), 1):.1%}",
        "object-frames cut off by the image's border": f"{stats.cut[..., 1:].sum() / max(seen.sum(), 1):.1%}",
        "mean occlusion of objects": _share(hidden),
        "object-frames hidden by half or more": f"{(hidden >= 0.5).sum() / max(np.isfinite(hidden).sum(), 1):.1%}",
        "trajectories in which the arm touches an object": f"{stats.touched.mean():.1%}",
        f"… and moves it by {MOVED_M * 100:.0f} cm or more": f"{stats.pushed.mean():.1%}",
        "trajectories in which objects touch each other": f"{stats.collided.mean():.1%}",
        "lines aimed at an object": f"{stats.aimed.mean():.1%}",
        "attempts redrawn": f"{stats.redraws.sum():,} of {tries:,} ({stats.redraws.sum() / tries:.1%})",
    }
    return "\n".join(f"| {name} | {value} |" for name, value in rows.items())


def _classes(manifest: Manifest, stats: Stats) -> str:
    lines = ["| class | trajectories | area | occlusion | moved ≥ 2 cm |", "|---|---|---|---|---|"]
    for number, name in enumerate(manifest.facts["classes"]):
        chosen = stats.classes == number
        area = np.swapaxes(stats.area[..., 1:], 1, 2)[chosen]
        hidden = np.swapaxes(stats.occlusion[..., 1:], 1, 2)[chosen]
        moved = (stats.moved_m[chosen] >= MOVED_M).astype(float)
        shares = " | ".join(_share(values) for values in (area, hidden, moved))
        lines.append(f"| {name} | {chosen.sum()} | {shares} |")
    return "\n".join(lines)


def _share(values: np.ndarray) -> str:
    """Mean of the finite values in per cent; a dash if there are none."""
    values = values[np.isfinite(values)]
    return f"{values.mean():.1%}" if values.size else "–"

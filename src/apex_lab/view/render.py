"""All pictures of an evaluation at once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from apex_lab.view.curves import curve_page
from apex_lab.view.film import film_strip
from apex_lab.view.item import Item
from apex_lab.view.movie import movie
from apex_lab.view.panels import component_panels


def render_all(
    folder: Path, items: Sequence[Item], curves_csv: Path | None = None, columns: int = 8, fps: float = 5.0
) -> list[Path]:
    """Makes film_strip.png, movie.mp4, movie.gif, components_<name>.png per video and, with a table, curves.png.

    Args:
        folder: where to; made if it is missing, files of the same name are replaced.
        items: videos to draw, (name, video, scene, b, segmentation) each; at least one, names all different.
        curves_csv: a run's curves; None leaves the page out.
        columns: frames of a film strip.
        fps: frames per second of the movies.

    Returns:
        The files, the film strip first.

    Raises:
        ValueError: items that do not fit each other, or share a name.
        UserError: a file cannot be written, or the table of curves cannot be read.
    """
    panels = [folder / f"components_{_slug(item.name)}.png" for item in items]
    if len(set(panels)) < len(panels):
        raise ValueError(f"items have names {[item.name for item in items]}, expected all different")
    strip, mp4, gif, curves = (folder / name for name in ("film_strip.png", "movie.mp4", "movie.gif", "curves.png"))
    film_strip(strip, items, columns)
    movie(mp4, items, fps)
    movie(gif, items, fps)
    for path, item in zip(panels, items, strict=True):
        component_panels(path, item)
    if curves_csv is not None:
        curve_page(curves, curves_csv)
    return [strip, mp4, gif, *panels, *([curves] if curves_csv is not None else [])]


def _slug(name: str) -> str:
    """A name as part of a file name, without a remark in brackets at its end."""
    return re.sub(r"[^a-z0-9.]+", "_", re.sub(r" \([^()]*\)$", "", name).lower()).strip("_.")[:60] or "video"

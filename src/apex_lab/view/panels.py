"""One row per component of a video: mask, appearance and window in three frames of its life, presence over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw

from apex_lab.scene import ABSENT, Scene
from apex_lab.view.canvas import FAINT, GAP, INK, MARGIN, cell_size, enlarge, fit, font, save_png, sheet
from apex_lab.view.colors import Color, color_of, rgb8
from apex_lab.view.item import Clip, Item

CELL = 96
"""Smallest width of a panel, in pixels."""
_BACKGROUND_TONE: Color = (225, 228, 232)
_LABELS = 130
_HEADING = 44
_CAPTION = 30
_PLOT = 270
_SCALE = 56
_TIME = 15
_STAGES = ("first frame", "middle", "last frame")
_COLUMNS = ("mask", "appearance", "window")
_GROUP_GAP = 16


@dataclass(frozen=True)
class Life:
    """One identity over time.

    Attributes:
        identity: its number.
        background: it is background.
        component: (T,) index of the component that bears the identity, -1 where none does.
        presence: (T,) in [0, 1], 0 where none does.
        share: (T,) share of the image's pixels under its soft mask.
    """

    identity: int
    background: bool
    component: Int[np.ndarray, " T"]
    presence: Float[np.ndarray, " T"]
    share: Float[np.ndarray, " T"]

    @property
    def color(self) -> Color:
        """Of its mask in these panels: the identity's own, light grey for background."""
        return _BACKGROUND_TONE if self.background else color_of(self.identity)

    @property
    def frames(self) -> Int[np.ndarray, " F"]:
        """Frames in which it is there."""
        return np.flatnonzero(self.component >= 0)


def lives(scene: Scene) -> list[Life]:
    """All identities of a scene of one video (B = 1), the one with the largest share of pixels first.

    Where several components of a frame bear the same identity, the one with the largest mask stands for it.
    """
    ids = scene.ids[0].numpy()
    share = scene.masks[0].float().mean(dim=(2, 3)).numpy()
    presence = scene.presence[0].float().numpy()
    background = scene.background.numpy()
    found = []
    for identity in np.unique(ids[ids != ABSENT]).tolist():
        bears = ids == identity
        component = np.where(bears.any(axis=1), np.where(bears, share, -1.0).argmax(axis=1), -1)
        chosen, there = component[:, None].clip(min=0), component >= 0
        found.append(
            Life(
                identity=identity,
                background=bool(background[component[there]].any()),
                component=component,
                presence=np.where(there, np.take_along_axis(presence, chosen, axis=1)[:, 0], 0.0),
                share=np.where(there, np.take_along_axis(share, chosen, axis=1)[:, 0], 0.0),
            )
        )
    return sorted(found, key=lambda life: (-life.share.sum(), life.identity))


def component_panels(path: Path, item: Item, max_components: int = 10) -> None:
    """Draws each component of a video over time.

    A row shows, for the first, middle and last frame in which the identity is there: its soft mask, its own image
    (`Scene.means`; without them the input under its mask), and its window on the input (left out for models without
    windows). At the end: presence over time (bars) and the share of pixels under its mask (line, on an axis of
    its own, at the right).

    Args:
        path: PNG to write.
        item: the video.
        max_components: rows at most, those with the largest share of pixels.

    Raises:
        ValueError: the item's parts do not fit each other.
        UserError: the file cannot be written.
    """
    clip = Clip(item)
    everyone = lives(clip.scene)
    shown = everyone[:max_components]
    height, width = cell_size(*clip.size, CELL)
    columns = _COLUMNS if clip.scene.windows is not None else _COLUMNS[:-1]
    group = len(columns) * (width + GAP) + _GROUP_GAP
    page, draw = sheet(
        2 * MARGIN + _LABELS + len(_STAGES) * group + _PLOT,
        2 * MARGIN + _CAPTION + _HEADING + max(1, len(shown)) * (_TIME + height + 2 * GAP),
    )
    rest = f", {len(everyone) - len(shown)} smaller ones not shown" if len(everyone) > len(shown) else ""
    caption = f"{clip.name}: {len(everyone)} component{'s' * (len(everyone) != 1)}{rest}"
    draw.text((MARGIN, MARGIN), fit(caption, page.width - 2 * MARGIN, font(17, bold=True)), INK, font(17, bold=True))
    _headings(draw, width, group, columns, has_means=clip.scene.means is not None)
    for row, life in enumerate(shown):
        top = MARGIN + _CAPTION + _HEADING + row * (_TIME + height + 2 * GAP) + _TIME
        _label(draw, life, top + height // 2)
        for stage, t in _stages(life):
            left = MARGIN + _LABELS + stage * group
            draw.text((left, top - 2), f"t = {t}", FAINT, font(12), anchor="ls")
            for i, panel in enumerate(_panels(clip, life, int(t), (height, width))):
                page.paste(panel, (left + i * (width + GAP), top))
        page.paste(_plot(life, _PLOT, height), (MARGIN + _LABELS + len(_STAGES) * group, top))
    save_png(path, page)


def _stages(life: Life) -> list[tuple[int, int]]:
    """(place in `_STAGES`, frame) of what is drawn of a life, each frame once."""
    first, middle, last = life.frames[0], life.frames[len(life.frames) // 2], life.frames[-1]
    times = {int(middle): 1, int(last): 2} | {int(first): 0}  # the later entry wins
    return [(stage, t) for t, stage in times.items()]


def _headings(draw: ImageDraw.ImageDraw, width: int, group: int, columns: Sequence[str], has_means: bool) -> None:
    top = MARGIN + _CAPTION
    for stage, name in enumerate(_STAGES):
        left = MARGIN + _LABELS + stage * group
        draw.text((left + (group - _GROUP_GAP - GAP) // 2, top), name, INK, font(14, bold=True), anchor="mt")
        for i, column in enumerate(columns):
            text = column if column != "appearance" or has_means else "under mask"
            draw.text((left + i * (width + GAP) + width // 2, top + 36), text, FAINT, font(13), anchor="ms")
    left = MARGIN + _LABELS + len(_STAGES) * group
    draw.text((left + _PLOT // 2, top), "over time", INK, font(14, bold=True), anchor="mt")
    draw.text((left + _PLOT // 2, top + 36), "presence (bars), share of pixels (line)", FAINT, font(12), anchor="ms")


def _label(draw: ImageDraw.ImageDraw, life: Life, middle: int) -> None:
    """Colour, name and size of a component, left of its row."""
    draw.rectangle((MARGIN, middle - 26, MARGIN + 14, middle - 12), fill=life.color, outline=INK)
    name = f"id {life.identity}"
    draw.text((MARGIN + 22, middle - 19), name, INK, font(15, bold=True), anchor="lm")
    if life.background:
        draw.text((MARGIN, middle), "background", FAINT, font(13), anchor="lm")
    share = 100 * life.share[life.frames].mean()
    draw.text((MARGIN, middle + 17), f"{share:.1f} % of pixels", FAINT, font(13), anchor="lm")
    frames = len(life.frames)
    draw.text((MARGIN, middle + 34), f"{frames} frame{'s' * (frames != 1)}", FAINT, font(13), anchor="lm")


def _panels(clip: Clip, life: Life, t: int, size: tuple[int, int]) -> list[Image.Image]:
    """Mask, appearance and, if the model has them, window of one component at frame t."""
    scene, k = clip.scene, life.component[t]
    mask = scene.masks[0, t, k].numpy()[..., None]
    if scene.means is None:
        picture = enlarge(clip.frames[t], mask.shape[:2]) / 255 * mask
    else:
        picture = scene.means[0, t, k].permute(1, 2, 0).numpy()
    painted = [rgb8(mask * np.array(life.color) / 255), rgb8(picture)]
    cells = [Image.fromarray(enlarge(pixels, size)) for pixels in painted]
    if scene.windows is not None:
        view = Image.fromarray(enlarge(clip.frames[t], size))
        cells.append(_window(view, scene.windows[0, t, k].numpy(), color_of(life.identity)))
    return cells


def _window(picture: Image.Image, window: Float[np.ndarray, "4"], color: Color) -> Image.Image:
    """Draws a window (s_y, s_x, t_y, t_x) on a picture; where it is NaN the picture is dimmed."""
    if not np.isfinite(window).all():
        dim: UInt8[np.ndarray, "h w 3"] = rgb8(0.35 * np.asarray(picture) / 255)
        page = Image.fromarray(dim)
        middle = (page.width // 2, page.height // 2)
        ImageDraw.Draw(page).text(middle, "no window", (200, 204, 210), font(12), anchor="mm")
        return page
    s_y, s_x, t_y, t_x = window.astype(float)
    half = np.abs([s_x * picture.width, s_y * picture.height]) / 2
    centre = np.array([(t_x + 1) * picture.width, (t_y + 1) * picture.height]) / 2
    # far outside the picture is as good as anywhere outside, and keeps the drawing library within its integers
    limit = 4 * max(picture.size)
    (left, top), (right, bottom) = (np.rint(edge).clip(-limit, limit) for edge in (centre - half, centre + half))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((left - 1, top - 1, right + 1, bottom + 1), outline=(0, 0, 0), width=4)
    draw.rectangle((left, top, right, bottom), outline=color, width=2)
    return picture


def _plot(life: Life, width: int, height: int) -> Image.Image:
    """Presence as bars (axis at the left) and share of pixels as a line (axis at the right), over frames."""
    fine = 3  # drawn larger and scaled down, which smooths the line
    page, draw = sheet(width * fine, height * fine)
    left, right, bottom, top = 30 * fine, (width - _SCALE) * fine, (height - 18) * fine, 6 * fine
    frames = len(life.presence)
    step = (right - left) / frames
    air = min(fine, step / 4)
    tall = bottom - top
    for t, presence in enumerate(np.nan_to_num(life.presence).clip(0, 1)):
        if presence > 0:
            box = (left + t * step + air, bottom - presence * tall, left + (t + 1) * step - air, bottom)
            draw.rectangle(box, fill=life.color)
    largest = life.share.max()
    if largest > 0:
        points = [(left + (t + 0.5) * step, bottom - y / largest * tall) for t, y in enumerate(life.share)]
        for t in life.frames:
            x, y = points[t]
            draw.ellipse((x - 2 * fine, y - 2 * fine, x + 2 * fine, y + 2 * fine), fill=INK)
            if t > 0 and life.component[t - 1] >= 0:
                draw.line((points[t - 1], points[t]), fill=INK, width=2 * fine)
    draw.line((left, bottom, right, bottom), fill=FAINT, width=fine)
    draw.line((left, top, left, bottom), fill=FAINT, width=fine)
    page = page.resize((width, height), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(page)
    draw.text((26, 6), "1", FAINT, font(11), anchor="rt")
    draw.text((26, height - 18), "0", FAINT, font(11), anchor="rb")
    for value, y, anchor in ((largest, 6, "lt"), (0.0, height - 18, "lb")):
        draw.text((width - _SCALE + 4, y), f"{100 * value:.{int(value > 0)}f} %", INK, font(11), anchor=anchor)
    draw.text((30, height - 4), "t = 0", FAINT, font(11), anchor="lb")
    if frames > 1:
        draw.text((width - _SCALE, height - 4), f"{frames - 1}", FAINT, font(11), anchor="rb")
    return page

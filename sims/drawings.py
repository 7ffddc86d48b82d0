"""Procedural textures of the fourteen objects: labels, stripes, lettering-like marks, peel; no artwork is copied.

Textures are drawn large and downsampled to the requested size, which smooths them: the renderer does not filter.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from sims.textures import BOX_TILES, STRIP_HEIGHT, WRAP

Colour = tuple[int, int, int]
LARGE = (1536, 1024)

WHITE, BLACK, CREAM = (246, 244, 238), (28, 26, 30), (244, 230, 200)
METAL, DARK_METAL = (176, 180, 186), (128, 132, 140)


class Canvas:
    """A part of the large texture, drawn in coordinates from 0 to 1, y downwards."""

    def __init__(self, image: Image.Image, box: tuple[float, float, float, float], seed: int = 0) -> None:
        self.image, self.pen = image, ImageDraw.Draw(image)
        self.left, self.top = round(box[0] * LARGE[0]), round(box[1] * LARGE[1])
        self.width, self.height = round(box[2] * LARGE[0]) - self.left, round(box[3] * LARGE[1]) - self.top
        self.rng = np.random.default_rng(seed)

    def at(self, x: float, y: float) -> tuple[float, float]:
        return self.left + x * self.width, self.top + y * self.height

    def box(self, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        """A rectangle."""
        (left, top), (right, bottom) = self.at(x0, y0), self.at(x1, y1)
        self.pen.rectangle((left, top, right - 1, bottom - 1), fill=colour)

    def fill(self, colour: Colour) -> None:
        self.box(0, 0, 1, 1, colour)

    def disc(self, x: float, y: float, radius: float, colour: Colour, flat: float = 1.0) -> None:
        """A circle whose radius is a share of the canvas' height; `flat` stretches it sideways."""
        (cx, cy), r = self.at(x, y), radius * self.height
        self.pen.ellipse((cx - r * flat, cy - r, cx + r * flat, cy + r), fill=colour)

    def shape(self, points: list[tuple[float, float]], colour: Colour) -> None:
        self.pen.polygon([self.at(x, y) for x, y in points], fill=colour)

    def letters(self, x0: float, y0: float, x1: float, y1: float, count: int, colour: Colour) -> None:
        """A word of letter-like marks: strokes on a grid of 2 x 3 points, like no real alphabet."""
        (left, top), (right, bottom) = self.at(x0, y0), self.at(x1, y1)
        pitch = (right - left) / count
        width, height = pitch * 0.66, bottom - top
        stroke = int(max(2, 0.24 * min(width * 1.3, height)))
        for number in range(count):
            origin = left + pitch * (number + 0.17)
            knots = [(origin + i * width, top + j * height / 2) for j in range(3) for i in range(2)]
            order = self.rng.permutation(6)[: int(self.rng.integers(4, 6))]
            path = [knots[2 * j] for j in range(3)] + [knots[k] for k in order]
            self.pen.line(path, fill=colour, width=stroke, joint="curve")

    def text(self, x0: float, y0: float, x1: float, y1: float, lines: int, colour: Colour) -> None:
        """A block of small print: broken grey lines."""
        for number in range(lines):
            y = y0 + (y1 - y0) * (number + 0.5) / lines
            x = x0
            while x < x1 - 0.02:
                word = min(float(self.rng.uniform(0.05, 0.16)), x1 - x)
                self.box(x, y - 0.22 * (y1 - y0) / lines, x + word, y + 0.22 * (y1 - y0) / lines, colour)
                x += word + 0.03

    def speckle(self, count: int, colour: Colour, size: tuple[float, float], stretch: float = 1.0) -> None:
        """Irregular spots; size in shares of the height, `stretch` lengthens them downwards."""
        for _ in range(count):
            x, y = self.rng.random(2)
            radius = float(self.rng.uniform(*size))
            (cx, cy), r = self.at(float(x), float(y)), radius * self.height
            self.pen.ellipse((cx - r, cy - r * stretch, cx + r, cy + r * stretch), fill=colour)

    def ramp(self, stops: list[tuple[float, Colour]]) -> None:
        """A smooth change of colour from the canvas' top (0) to its bottom (1)."""
        rows = self.height
        places = np.linspace(0, 1, rows)
        column = np.stack(
            [np.interp(places, [s for s, _ in stops], [c[i] for _, c in stops]) for i in range(3)], axis=1
        )
        strip = np.repeat(column[:, None].astype(np.uint8), self.width, axis=1)
        self.image.paste(Image.fromarray(strip), (self.left, self.top))


def _tiles(image: Image.Image, seed: int) -> dict[str, Canvas]:
    canvases = {}
    for number, name in enumerate(BOX_TILES):
        column, row = number % 3, number // 3
        canvases[name] = Canvas(image, (column / 3, row / 2, (column + 1) / 3, (row + 1) / 2), seed + number)
    return canvases


def _can(image: Image.Image, seed: int) -> tuple[Canvas, Canvas, Canvas, Canvas]:
    """One turn of the strip, and the tiles of top, bottom and inside; `_wrap` finishes the strip."""
    edge = WRAP / (1 + 2 * WRAP)
    strip = Canvas(image, (edge, 0, 1 - edge, STRIP_HEIGHT), seed)
    caps = (Canvas(image, (i / 3, STRIP_HEIGHT, (i + 1) / 3, 1), seed + i + 1) for i in range(3))
    return strip, *caps  # type: ignore[return-value]


def _around(image: Image.Image, seed: int) -> Canvas:
    edge = WRAP / (1 + 2 * WRAP)
    return Canvas(image, (edge, 0, 1 - edge, 1), seed)


def _wrap(image: Image.Image, height: float) -> None:
    """Turn a strip by a quarter, so that what was drawn at a quarter faces front, and repeat its ends at its ends."""
    margin = round(LARGE[0] * WRAP / (1 + 2 * WRAP))
    rows = round(LARGE[1] * height)
    turn = np.asarray(image)[:rows, margin : LARGE[0] - margin]
    turned = np.roll(turn, turn.shape[1] // 4, axis=1)
    whole = np.concatenate([turned[:, -margin:], turned, turned[:, :margin]], axis=1)
    image.paste(Image.fromarray(whole), (0, 0))


def _master_chef_can(image: Image.Image) -> None:
    strip, top, bottom, inside = _can(image, 2)
    strip.fill((24, 48, 128))
    for x in (0.02, 0.52):
        strip.box(x, 0.28, x + 0.46, 0.62, WHITE)
        strip.letters(x + 0.03, 0.34, x + 0.43, 0.55, 6, (196, 30, 40))
        strip.text(x + 0.08, 0.72, x + 0.38, 0.86, 2, (236, 200, 90))
    strip.box(0, 0.16, 1, 0.22, (226, 176, 60))
    strip.box(0, 0.0, 1, 0.06, METAL)
    strip.box(0, 0.95, 1, 1, METAL)
    top.fill((150, 110, 74))
    top.disc(0.5, 0.5, 0.38, (124, 88, 58))
    bottom.fill(METAL)
    inside.fill((150, 110, 74))


def _cracker_box(image: Image.Image) -> None:
    tiles = _tiles(image, 3)
    red, orange = (190, 24, 36), (240, 150, 40)
    for name in ("front", "back"):
        face = tiles[name]
        face.fill(red)
        face.shape([(0, 0.16), (1, 0.08), (1, 0.36), (0, 0.44)], (250, 214, 60))
        face.letters(0.1, 0.18, 0.9, 0.34, 5, red)
        for x, y in ((0.24, 0.6), (0.55, 0.54), (0.42, 0.78), (0.78, 0.72)):
            face.box(x - 0.13, y - 0.09, x + 0.13, y + 0.09, orange)
            face.disc(x, y, 0.02, (150, 80, 20))
        face.text(0.08, 0.9, 0.92, 0.97, 1, WHITE)
    for name in ("left", "right"):
        face = tiles[name]
        face.fill(red)
        face.box(0.12, 0.3, 0.88, 0.9, WHITE)
        face.text(0.18, 0.34, 0.82, 0.86, 8, (90, 90, 90))
        face.letters(0.1, 0.08, 0.9, 0.22, 4, (250, 214, 60))
    for name in ("top", "bottom"):
        tiles[name].fill(red)
        tiles[name].letters(0.15, 0.3, 0.85, 0.7, 5, (250, 214, 60))


def _sugar_box(image: Image.Image) -> None:
    tiles = _tiles(image, 4)
    yellow, blue = (252, 212, 40), (28, 60, 160)
    for name in ("front", "back", "left", "right"):
        face = tiles[name]
        face.fill(yellow)
        face.box(0, 0.62, 1, 1, WHITE)
        face.box(0, 0.58, 1, 0.64, blue)
        if name in ("front", "back"):
            face.disc(0.5, 0.3, 0.17, blue, flat=2.2)
            face.letters(0.2, 0.22, 0.8, 0.38, 5, WHITE)
            face.letters(0.2, 0.7, 0.8, 0.8, 4, blue)
        face.text(0.15, 0.85, 0.85, 0.95, 2, (120, 120, 130))
    for name in ("top", "bottom"):
        tiles[name].fill(yellow)
        tiles[name].box(0.0, 0.35, 1, 0.65, blue)


def _tomato_soup_can(image: Image.Image) -> None:
    strip, top, bottom, inside = _can(image, 5)
    red = (206, 28, 38)
    strip.fill(WHITE)
    strip.box(0, 0.06, 1, 0.52, red)
    for x in (0.0, 0.5):
        strip.letters(x + 0.06, 0.16, x + 0.44, 0.38, 6, WHITE)
        strip.disc(x + 0.25, 0.53, 0.13, (214, 172, 70))
        strip.disc(x + 0.25, 0.53, 0.08, (240, 214, 140))
        strip.letters(x + 0.1, 0.72, x + 0.4, 0.86, 6, red)
    strip.box(0, 0, 1, 0.06, METAL)
    strip.box(0, 0.94, 1, 1, METAL)
    for cap in (top, bottom, inside):
        cap.fill(METAL)
        cap.disc(0.5, 0.5, 0.4, DARK_METAL)
        cap.disc(0.5, 0.5, 0.34, METAL)


def _mustard_bottle(image: Image.Image) -> None:
    strip, top, bottom, inside = _can(image, 6)
    yellow = (244, 196, 22)
    strip.fill(yellow)
    strip.box(0, 0, 1, 0.17, (196, 30, 36))
    for x in (0.25, 0.75):
        strip.shape([(x - 0.2, 0.42), (x, 0.36), (x + 0.2, 0.42), (x + 0.2, 0.78), (x, 0.84), (x - 0.2, 0.78)], WHITE)
        strip.shape([(x - 0.2, 0.48), (x + 0.2, 0.44), (x + 0.2, 0.62), (x - 0.2, 0.66)], (196, 30, 36))
        strip.letters(x - 0.16, 0.5, x + 0.16, 0.61, 7, WHITE)
        strip.letters(x - 0.12, 0.69, x + 0.12, 0.76, 6, (30, 60, 130))
    top.fill((196, 30, 36))
    bottom.fill(yellow)
    inside.fill(yellow)


def _pudding_box(image: Image.Image) -> None:
    tiles = _tiles(image, 8)
    brown, pink = (84, 46, 30), (226, 90, 130)
    for name in ("top", "bottom"):
        face = tiles[name]
        face.fill(brown)
        face.shape([(0, 0), (1, 0), (1, 0.3), (0, 0.42)], CREAM)
        face.letters(0.1, 0.08, 0.9, 0.26, 6, pink)
        face.disc(0.64, 0.7, 0.24, CREAM, flat=1.1)
        face.disc(0.64, 0.7, 0.19, (122, 72, 44), flat=1.1)
        face.disc(0.6, 0.64, 0.07, WHITE, flat=1.2)
        face.text(0.06, 0.56, 0.34, 0.9, 4, CREAM)
    for name in ("front", "back", "left", "right"):
        face = tiles[name]
        face.fill(brown)
        face.box(0, 0.0, 1, 0.3, pink)
        face.letters(0.12, 0.42, 0.88, 0.85, 6, CREAM)


def _potted_meat_can(image: Image.Image) -> None:
    tiles = _tiles(image, 10)
    blue, yellow = (26, 36, 112), (252, 214, 50)
    for name in ("front", "back"):
        face = tiles[name]
        face.fill(blue)
        face.letters(0.12, 0.12, 0.88, 0.42, 4, yellow)
        face.shape([(0.2, 0.56), (0.72, 0.5), (0.82, 0.82), (0.28, 0.9)], (226, 140, 126))
        face.shape([(0.72, 0.5), (0.92, 0.56), (0.82, 0.82)], (190, 100, 90))
        face.box(0, 0.94, 1, 1, METAL)
        face.box(0, 0, 1, 0.06, METAL)
    for name in ("left", "right"):
        face = tiles[name]
        face.fill(blue)
        face.box(0.12, 0.16, 0.88, 0.84, yellow)
        face.text(0.18, 0.22, 0.82, 0.8, 6, blue)
        face.box(0, 0.94, 1, 1, METAL)
        face.box(0, 0, 1, 0.06, METAL)
    for name in ("top", "bottom"):
        tiles[name].fill(METAL)
        tiles[name].box(0.12, 0.12, 0.88, 0.88, DARK_METAL)
        tiles[name].box(0.16, 0.17, 0.84, 0.83, METAL)


def _banana(image: Image.Image) -> None:
    strip = _around(image, 11)
    brown = (78, 54, 30)
    yellow, green = (248, 212, 50), (196, 196, 70)
    strip.ramp(
        [
            (0, brown),
            (0.05, brown),
            (0.1, green),
            (0.22, yellow),
            (0.88, yellow),
            (0.94, green),
            (0.97, brown),
            (1, brown),
        ]
    )
    for x in (0.08, 0.33, 0.58, 0.83):
        strip.box(x, 0.1, x + 0.02, 0.93, (214, 170, 40))
    strip.speckle(60, (128, 88, 36), (0.004, 0.013), stretch=2.0)


def _apple(image: Image.Image) -> None:
    strip = _around(image, 13)
    strip.ramp(
        [(0, (176, 170, 70)), (0.2, (198, 110, 50)), (0.36, (184, 28, 34)), (0.8, (160, 18, 30)), (1, (150, 120, 50))]
    )
    for _ in range(46):
        x, y = strip.rng.random(), strip.rng.uniform(0.15, 0.45)
        strip.box(x, y, x + 0.008, y + strip.rng.uniform(0.1, 0.35), (222, 120, 60))
    strip.speckle(90, (232, 176, 110), (0.003, 0.007))
    strip.box(0, 0, 1, 0.07, (70, 48, 26))
    strip.box(0, 0.96, 1, 1, (80, 60, 34))


def _pear(image: Image.Image) -> None:
    strip = _around(image, 16)
    strip.ramp(
        [(0, (90, 110, 40)), (0.12, (150, 178, 56)), (0.6, (188, 200, 74)), (0.94, (164, 176, 60)), (1, (96, 84, 40))]
    )
    for step in range(8):
        strip.disc(0.3, 0.55, 0.3 - 0.03 * step, (190 + 3 * step, 196 - 5 * step, 74), flat=0.9)
    strip.speckle(150, (120, 116, 44), (0.003, 0.009))
    strip.box(0, 0, 1, 0.03, (70, 50, 28))
    strip.box(0, 0.97, 1, 1, (70, 50, 28))


def _orange(image: Image.Image) -> None:
    strip = _around(image, 17)
    strip.ramp([(0, (226, 120, 14)), (0.5, (250, 146, 22)), (1, (232, 124, 16))])
    strip.speckle(420, (220, 112, 12), (0.004, 0.009))
    strip.speckle(160, (255, 176, 70), (0.003, 0.007))
    strip.box(0, 0, 1, 0.06, (84, 110, 40))
    strip.box(0, 0.96, 1, 1, (196, 116, 40))


def _bleach_cleanser(image: Image.Image) -> None:
    strip, top, bottom, inside = _can(image, 21)
    strip.fill(WHITE)
    strip.box(0, 0, 1, 0.13, (20, 90, 190))
    for x in (0.25, 0.75):
        strip.shape([(x - 0.21, 0.4), (x + 0.21, 0.34), (x + 0.21, 0.86), (x - 0.21, 0.86)], (0, 138, 130))
        strip.letters(x - 0.17, 0.44, x + 0.17, 0.56, 6, WHITE)
        strip.shape([(x - 0.21, 0.62), (x + 0.21, 0.58), (x + 0.21, 0.68), (x - 0.21, 0.72)], (246, 150, 30))
        strip.text(x - 0.16, 0.75, x + 0.16, 0.84, 2, WHITE)
    top.fill((20, 90, 190))
    bottom.fill(WHITE)
    inside.fill(WHITE)


def _mug(image: Image.Image) -> None:
    strip, top, bottom, inside = _can(image, 25)
    teal = (20, 150, 140)
    strip.fill(teal)
    strip.box(0, 0.0, 1, 0.1, WHITE)
    strip.box(0, 0.84, 1, 0.92, (250, 226, 170))
    for row, y in enumerate((0.3, 0.5, 0.7)):
        for number in range(8):
            strip.disc((number + 0.5 * (row % 2) + 0.25) / 8, y, 0.065, (250, 226, 170))
    top.fill(WHITE)
    bottom.fill(teal)
    inside.fill(WHITE)


def _foam_brick(image: Image.Image) -> None:
    for name, face in _tiles(image, 61).items():
        face.fill((178, 84, 62) if name in ("top", "bottom") else (160, 70, 52))
        face.speckle(150, (120, 46, 36), (0.008, 0.025))
        face.speckle(60, (214, 130, 100), (0.006, 0.016))
        face.box(0, 0, 1, 0.05, (204, 118, 92))


DRAWINGS: dict[str, tuple[Callable[[Image.Image], None], float]] = {
    "master_chef_can": (_master_chef_can, STRIP_HEIGHT),
    "cracker_box": (_cracker_box, 0.0),
    "sugar_box": (_sugar_box, 0.0),
    "tomato_soup_can": (_tomato_soup_can, STRIP_HEIGHT),
    "mustard_bottle": (_mustard_bottle, STRIP_HEIGHT),
    "pudding_box": (_pudding_box, 0.0),
    "potted_meat_can": (_potted_meat_can, 0.0),
    "banana": (_banana, 1.0),
    "apple": (_apple, 1.0),
    "pear": (_pear, 1.0),
    "orange": (_orange, 1.0),
    "bleach_cleanser": (_bleach_cleanser, STRIP_HEIGHT),
    "mug": (_mug, STRIP_HEIGHT),
    "foam_brick": (_foam_brick, 0.0),
}
"""How each class is drawn, and which share of its picture is a strip that runs around."""


def draw(name: str, height_px: int) -> Image.Image:
    """The picture of one class, 1.5 `height_px` wide."""
    image = Image.new("RGB", LARGE, WHITE)
    picture, strip = DRAWINGS[name]
    picture(image)
    if strip:
        _wrap(image, strip)
    image = image.filter(ImageFilter.GaussianBlur(0.5 * LARGE[1] / height_px))
    return image.resize((round(1.5 * height_px), height_px), Image.Resampling.BOX)

"""Antialiased drawing with Pillow: a view maps metres to pixels, a canvas draws shapes."""

from __future__ import annotations

import functools
import io
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

Floats = NDArray[np.float64]
Colour = tuple[int, ...]
"""Red, green, blue and optionally alpha, each 0-255."""
Bounds = tuple[float, float, float, float]
"""(x_min, y_min, x_max, y_max) [m]."""
Up = Literal["x", "y"]
"""Axis that points up in the picture: x, in which a robot starts driving, or y, as on a map."""
FINE_SCALE = 2
"""Supersampling factor in each direction, for antialiasing."""
MAX_PIXEL = 1e4
"""Coordinates are clipped to this [fine pixels], as Pillow's time grows with a line's length."""
MIN_SIDE, MAX_SIDE = 64, 4096
"""Smallest and largest width and height of a picture [pixels]."""
TEXT_HEIGHT = 12.0
"""Height of text [pixels]."""
TEXT_PADDING = 4.0
"""Distance between text and the edges of its box [pixels]."""
INK_COLOUR: Colour = (70, 76, 88)
LABEL_COLOUR: Colour = (255, 255, 255, 205)


@dataclass(frozen=True, slots=True)
class View:
    """The part of the plane that a picture shows. Pixels are (column, row) from the upper left."""

    centre: tuple[float, float]
    """Position at the centre of the picture [m]."""
    scale: float
    """Scale [pixels/m]."""
    size: tuple[int, int]
    """Width and height [pixels]."""
    up: Up = "x"

    @classmethod
    def fitted(cls, bounds: Bounds, size: tuple[int, int], up: Up, inset: float) -> View:
        """Return the largest view that shows all of `bounds`, `inset` pixels from every edge."""
        left, low, right, high = bounds
        across, along = (high - low, right - left) if up == "x" else (right - left, high - low)
        room = [max(1.0, side - 2.0 * inset) for side in size]
        scale = min(room[0] / max(across, 1e-3), room[1] / max(along, 1e-3))
        return cls(((left + right) / 2.0, (low + high) / 2.0), scale, size, up)

    def pixels(self, points: Floats) -> Floats:
        """Convert points (N, 2) [m] to columns and rows (N, 2) [pixels]."""
        across, along = points[:, 0] - self.centre[0], points[:, 1] - self.centre[1]
        if self.up == "x":
            across, along = -along, across
        result = np.empty((len(points), 2))
        result[:, 0] = self.size[0] / 2.0 + self.scale * across
        result[:, 1] = self.size[1] / 2.0 - self.scale * along
        return result

    def shows(self, x: float, y: float, inset: float) -> bool:
        """Return whether a point [m] is at least `inset` pixels from every edge."""
        column, row = self.pixels(np.array([[x, y]]))[0]
        width, height = self.size
        return bool(inset <= column <= width - inset and inset <= row <= height - inset)

    @property
    def bounds(self) -> Bounds:
        """Area that the picture shows [m]."""
        width, height = self.size if self.up == "y" else self.size[::-1]
        x, y = width / 2.0 / self.scale, height / 2.0 / self.scale
        return self.centre[0] - x, self.centre[1] - y, self.centre[0] + x, self.centre[1] + y


class Canvas:
    """A picture being drawn. Positions and radii are in m, widths of lines in pixels.

    Raises MissingExtraError without Pillow.
    """

    def __init__(self, view: View, ground: Picture | Colour) -> None:
        """`ground` is a colour, or the `layer` of a canvas of the same size to start from."""
        pillow = _pillow()
        size = (FINE_SCALE * view.size[0], FINE_SCALE * view.size[1])
        self.view = view
        self.layer = (
            pillow.Image.new("RGB", size, ground) if isinstance(ground, tuple) else ground.copy()
        )
        """The picture at FINE_SCALE times its width and height."""
        self._draw = pillow.ImageDraw.Draw(self.layer, "RGBA")
        self._fine = replace(view, scale=FINE_SCALE * view.scale, size=size)

    def _fine_pixels(self, points: Floats, *, apart: float = 0.0) -> list[float]:
        """Return columns and rows in turn [fine pixels]; leaves out points closer than `apart`."""
        places = self._fine.pixels(points)
        if not np.isfinite(places).all():
            places = places[np.isfinite(places).all(axis=1)]
        places = places.clip(-MAX_PIXEL, MAX_PIXEL)
        if apart and len(places) > 2:
            mark = (np.hypot(*np.diff(places, axis=0).T).cumsum() / apart).astype(np.int64)
            kept = np.ones(len(places), np.bool_)  # one point per `apart`, the first and the last
            kept[1:-1] = np.diff(mark, prepend=0)[:-1] > 0
            places = places[kept]
        flat: list[float] = places.ravel().tolist()
        return flat

    def line(self, points: Floats, colour: Colour, width: float) -> None:
        """Draw a line through points (N, 2); nothing for fewer than two."""
        places = self._fine_pixels(points, apart=1.5 * FINE_SCALE)
        if len(places) >= 4:
            self._draw.line(places, fill=colour, width=round(FINE_SCALE * width))

    def rays(self, start: Floats, ends: Floats, colour: Colour) -> None:
        """Draw thin lines from one point (1, 2) to many (N, 2)."""
        places, ends_flat = self._fine_pixels(start), self._fine_pixels(ends)
        for at in range(0, len(ends_flat) if places else 0, 2):
            self._draw.line([*places, *ends_flat[at : at + 2]], fill=colour)

    def dashes(self, points: Floats, colour: Colour, width: float, dash: float) -> None:
        """Draw a dashed line through points (N, 2); dashes and gaps are `dash` pixels long."""
        if len(points) < 2:
            return
        length = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
        stops = np.arange(0.0, length[-1], dash / self.view.scale)
        for start, end in zip(stops[::2], [*stops[1::2], length[-1]], strict=False):
            inner = length[(length > start) & (length < end)]
            at = np.array([start, *inner, end])
            part = np.column_stack([np.interp(at, length, axis) for axis in points.T])
            self.line(part, colour, width)

    def shape(
        self, points: Floats, fill: Colour, edge: Colour | None = None, width: float = 1.0
    ) -> None:
        """Draw a polygon with corners (N, 2)."""
        places = self._fine_pixels(points)
        if len(places) >= 6:
            self._draw.polygon(places, fill=fill, outline=edge, width=round(FINE_SCALE * width))

    def reveal(self, layer: Picture, points: Floats) -> None:
        """Copy the inside of a polygon with corners (N, 2) from a layer of the same size."""
        places = self._fine_pixels(points)
        if len(places) >= 6:
            pillow = _pillow()
            mask = pillow.Image.new("1", self.layer.size)
            pillow.ImageDraw.Draw(mask).polygon(places, fill=1)
            self.layer.paste(layer, (0, 0), mask)

    def disc(
        self,
        place: tuple[float, float],
        radius: float,
        fill: Colour,
        edge: Colour | None = None,
        *,
        width: float = 1.0,
        least: float = 0.5,
    ) -> None:
        """Draw a disc of `radius` [m], but at least `least` pixels."""
        pixels = max(radius * self.view.scale, least)
        self.dots(np.array([place]), pixels, fill, edge, width)

    def dots(
        self,
        points: Floats,
        radius: float,
        fill: Colour,
        edge: Colour | None = None,
        width: float = 1.0,
    ) -> None:
        """Draw discs of `radius` pixels around points (N, 2)."""
        flat, size = self._fine_pixels(points), FINE_SCALE * radius
        for column, row in zip(flat[::2], flat[1::2], strict=True):
            box = (column - size, row - size, column + size, row + size)
            self._draw.ellipse(box, fill=fill, outline=edge, width=round(FINE_SCALE * width))

    def scale_bar(self, row: float, share: float, inset: float, *, right: bool = False) -> float:
        """Draw a scale bar of at most a share of the width; returns its length [pixels]."""
        width, scale = self.view.size[0], self.view.scale
        metres = round_length(share * width / scale)
        length = metres * scale
        column = width - inset - length if right else inset
        left, low, tick = FINE_SCALE * column, FINE_SCALE * row, FINE_SCALE * 4.0
        end, pad = left + FINE_SCALE * length, FINE_SCALE * TEXT_PADDING
        top = low - FINE_SCALE * (TEXT_HEIGHT + 6.0)
        self._draw.rounded_rectangle((left - pad, top, end + pad, low + pad), pad, LABEL_COLOUR)
        line = (left, low - tick, left, low, end, low, end, low - tick)
        self._draw.line(line, INK_COLOUR, FINE_SCALE)
        label = f"{metres:g} m" if metres >= 1.0 else f"{100.0 * metres:g} cm"
        self.text((column + length / 2.0, row - 4.0), label, anchor="ms")
        return length

    def band(self, height: float, edge: Colour) -> None:
        """Draw a strip along the top, with lines below it and around the picture."""
        right, low = self.layer.width - 1, self.layer.height - 1
        strip = (0, 0, right, FINE_SCALE * height)
        self._draw.rectangle(strip, fill=LABEL_COLOUR[:3])
        self._draw.line((0, strip[3], right, strip[3]), edge, FINE_SCALE)
        self._draw.rectangle((0, 0, right, low), outline=edge, width=FINE_SCALE)

    def text(
        self,
        place: tuple[float, float],
        words: str,
        *,
        anchor: str = "ls",
        box: Colour | None = None,
    ) -> None:
        """Draw text at a pixel, on a box if `box` is a colour; `anchor` is Pillow's text anchor."""
        at, font = (FINE_SCALE * place[0], FINE_SCALE * place[1]), _font()
        if box is not None:
            left, top, right, low = self._draw.textbbox(at, words, font, anchor)
            pad = FINE_SCALE * TEXT_PADDING
            edges = (left - pad, top - pad, right + pad, low + pad)
            self._draw.rounded_rectangle(edges, radius=pad, fill=box)
        self._draw.text(at, words, INK_COLOUR, font, anchor)

    def picture(self) -> NDArray[np.uint8]:
        """Return the picture, (height, width, 3)."""
        return np.array(self.layer.reduce(FINE_SCALE))


def shorten_text(words: str, room: float) -> str:
    """Shorten text to fit into `room` pixels, with an ellipsis."""
    kept = words
    while kept and _font().getlength(kept + "…" * (kept != words)) > FINE_SCALE * room:
        kept = kept[:-1]
    return kept if kept == words else kept + "…"


def round_length(most: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most `most`."""
    power = 10.0 ** math.floor(math.log10(most))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= most * (1.0 + 1e-9))


def encode_png(image: NDArray[np.uint8], comment: str = "") -> bytes:
    """Encode a picture (height, width, 3) as PNG, with a comment in it."""
    file = io.BytesIO()
    pillow = _pillow()
    from PIL.PngImagePlugin import PngInfo  # noqa: PLC0415 - optional

    texts = PngInfo()
    if comment:
        texts.add_text("Comment", comment)
    pillow.Image.fromarray(image).save(file, "PNG", pnginfo=texts)
    return file.getvalue()


def check_picture_size(name: str, size: tuple[int, int]) -> None:
    """Raise ConfigError unless width and height are ints from MIN_SIDE to MAX_SIDE [pixels]."""
    try:
        sides = [MIN_SIDE <= side <= MAX_SIDE and side == int(side) for side in size]
    except (TypeError, ValueError):
        sides = []
    if sides != [True, True]:
        raise ConfigError(
            f"{name} = {size!r}: must be width and height, whole numbers of {MIN_SIDE} to "
            f"{MAX_SIDE} pixels"
        )


@functools.cache
def _font() -> Any:
    return _pillow().ImageFont.load_default(FINE_SCALE * TEXT_HEIGHT)


def _pillow() -> Any:
    """Import Pillow with the modules used here."""
    try:
        import PIL  # noqa: PLC0415 - optional
        import PIL.Image  # noqa: PLC0415
        import PIL.ImageDraw  # noqa: PLC0415
        import PIL.ImageFont  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("pictures", "pictures") from error
    return PIL

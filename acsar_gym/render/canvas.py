"""Antialiased drawing with Pillow: a view maps metres to pixels, a canvas draws shapes."""

from __future__ import annotations

import functools
import io
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.errors import ConfigError, require_extra

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

Floats = NDArray[np.float64]
Colour = tuple[int, ...]
"""Red, green, blue and optionally alpha, each 0-255."""
Bounds = Floats
"""[[x_min, y_min], [x_max, y_max]] [m]."""
Up = Literal["x", "y"]
"""Axis that points up in the picture: x, in which a robot starts driving, or y, as on a map."""

FINE_SCALE = 2
"""Supersampling factor in each direction, for antialiasing."""
MAX_PIXEL = 1e4
"""Coordinates are clipped to this [fine pixels], as Pillow's time grows with a line's length."""
MIN_SIDE = 64
MAX_SIDE = 4096
"""Smallest and largest width and height of a picture [pixels]."""
TEXT_HEIGHT = 12.0
"""Height of text [pixels]."""
TEXT_PADDING = 4.0
"""Distance between text and the edges of its box [pixels]."""
INK_COLOUR = (70, 76, 88)
LABEL_COLOUR = (255, 255, 255, 205)


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
        x, y = bounds.mean(axis=0).tolist()
        # Bounds of a single point have no extent, and would make the scale infinite.
        extent = np.ptp(bounds, axis=0).clip(1e-3)
        room = np.subtract(size, 2.0 * inset).clip(1.0)
        # With x up, the width of the picture shows y and its height shows x.
        scale = (room / (extent[::-1] if up == "x" else extent)).min()
        return cls((x, y), float(scale), size, up)

    def pixels(self, points: Floats) -> Floats:
        """Convert points (N, 2) [m] to columns and rows (N, 2) [pixels]."""
        # Rows of a picture count downwards.
        x, y = (points - self.centre).T
        across = -y if self.up == "x" else x
        ahead = x if self.up == "x" else y
        width, height = self.size
        return np.column_stack(
            [width / 2.0 + self.scale * across, height / 2.0 - self.scale * ahead]
        )

    def shows(self, x: float, y: float, inset: float) -> bool:
        """Return whether a point [m] is at least `inset` pixels from every edge."""
        pixel = self.pixels(np.array([[x, y]]))[0]
        return bool((pixel >= inset).all() and (pixel <= np.subtract(self.size, inset)).all())

    @property
    def bounds(self) -> Bounds:
        """Area that the picture shows [m]."""
        half = np.divide(self.size if self.up == "y" else self.size[::-1], 2.0) / self.scale
        return np.array([self.centre - half, self.centre + half])


class Canvas:
    """A picture being drawn. Positions and radii are in m, widths of lines in pixels.

    Args:
        view: Part of the plane.
        ground: Colour, or the `layer` of a canvas of the same size to start from.

    Attributes:
        view: Part of the plane.
        layer: The picture at FINE_SCALE times its width and height.
        pen: Pillow's drawing functions for the layer.

    Raises:
        MissingExtraError: Pillow isn't installed.
    """

    def __init__(self, view: View, ground: Picture | Colour) -> None:
        pillow = import_pillow()
        width, height = view.size
        self.view = view

        # Pillow doesn't antialias shapes: they are drawn larger, and `picture` averages them.
        self._fine = replace(
            view, scale=FINE_SCALE * view.scale, size=(FINE_SCALE * width, FINE_SCALE * height)
        )
        self.layer = (
            pillow.Image.new("RGB", self._fine.size, ground)
            if isinstance(ground, tuple)
            else ground.copy()
        )
        # In mode RGBA translucent colours are blended. In mode RGB their alpha would be ignored.
        self.pen = pillow.ImageDraw.Draw(self.layer, "RGBA")

    def _fine_pixels(self, points: Floats) -> Floats:
        """Convert points [m] to fine pixels, without those that aren't finite."""
        pixels = self._fine.pixels(points)
        return pixels[np.isfinite(pixels).all(axis=1)].clip(-MAX_PIXEL, MAX_PIXEL)

    def line(self, points: Floats, colour: Colour, width: float) -> None:
        """Draw a line through points (N, 2), or nothing for fewer than two."""
        pixels = thin_line(self._fine_pixels(points), 1.5 * FINE_SCALE)
        if len(pixels) >= 2:
            self.pen.line(flatten(pixels), fill=colour, width=round(FINE_SCALE * width))

    def rays(self, start: Floats, ends: Floats, colour: Colour) -> None:
        """Draw thin lines from one point (1, 2) to many (N, 2)."""
        origin = flatten(self._fine_pixels(start))
        # Without a finite pose there is no origin, and nothing can be drawn.
        for end in self._fine_pixels(ends).tolist() if origin else ():
            self.pen.line([*origin, *end], fill=colour)

    def shape(
        self, points: Floats, fill: Colour, edge: Colour | None = None, width: float = 1.0
    ) -> None:
        """Draw a polygon with corners (N, 2)."""
        corners = flatten(self._fine_pixels(points))
        # Fewer than three corners, which are six numbers, enclose no area.
        if len(corners) >= 6:
            self.pen.polygon(corners, fill=fill, outline=edge, width=round(FINE_SCALE * width))

    def reveal(self, layer: Picture, points: Floats) -> None:
        """Copy the inside of a polygon with corners (N, 2) from a layer of the same size."""
        pillow = import_pillow()
        # Pillow pastes whole rectangles, so the polygon is a mask.
        mask = pillow.Image.new("1", self.layer.size)
        corners = flatten(self._fine_pixels(points))
        if len(corners) >= 6:
            pillow.ImageDraw.Draw(mask).polygon(corners, fill=1)
        self.layer.paste(layer, (0, 0), mask)

    def discs(
        self,
        points: ArrayLike,
        radius: float,
        fill: Colour,
        edge: Colour | None = None,
        *,
        width: float = 1.0,
        least: float = 0.5,
    ) -> None:
        """Draw discs around points (N, 2) or (2,), of `radius` [m] but at least `least` pixels."""
        size = FINE_SCALE * max(radius * self.view.scale, least)
        pixels = self._fine_pixels(np.reshape(points, (-1, 2)))
        for box in np.hstack([pixels - size, pixels + size]).tolist():
            self.pen.ellipse(box, fill=fill, outline=edge, width=round(FINE_SCALE * width))

    def scale_bar(self, row: float, share: float, inset: float) -> None:
        """Draw a scale bar of at most a share of the width, `inset` pixels from the left."""
        metres = round_length(share * self.view.size[0] / self.view.scale)
        length = metres * self.view.scale
        start, end, low = (FINE_SCALE * pixel for pixel in (inset, inset + length, row))

        # A box behind the bar and its text.
        pad = FINE_SCALE * TEXT_PADDING
        top = low - FINE_SCALE * (TEXT_HEIGHT + 6.0)
        self.pen.rounded_rectangle((start - pad, top, end + pad, low + pad), pad, LABEL_COLOUR)
        tick = low - FINE_SCALE * 4.0
        self.pen.line((start, tick, start, low, end, low, end, tick), INK_COLOUR, FINE_SCALE)
        label = f"{metres:g} m" if metres >= 1.0 else f"{100.0 * metres:g} cm"
        self.text((inset + length / 2.0, row - 4.0), label, anchor="ms")

    def text(
        self,
        place: tuple[float, float],
        words: str,
        *,
        anchor: str = "ls",
        box: Colour | None = None,
    ) -> None:
        """Draw text at a pixel, on a box if `box` is a colour. `anchor` is Pillow's text anchor."""
        at = (FINE_SCALE * place[0], FINE_SCALE * place[1])
        font = load_font()
        if box is not None:
            pad = FINE_SCALE * TEXT_PADDING
            edges = np.add(self.pen.textbbox(at, words, font, anchor), (-pad, -pad, pad, pad))
            self.pen.rounded_rectangle(edges.tolist(), radius=pad, fill=box)
        self.pen.text(at, words, INK_COLOUR, font, anchor)

    def picture(self) -> NDArray[np.uint8]:
        """Return the picture, (height, width, 3)."""
        return np.array(self.layer.reduce(FINE_SCALE))


def flatten(pixels: Floats) -> list[float]:
    """Return columns and rows in turn, as Pillow reads them."""
    flat: list[float] = pixels.ravel().tolist()
    return flat


def path_lengths(points: Floats) -> Floats:
    """Return the length of a path from its start to each of its points (N,)."""
    steps = np.diff(points, axis=0)
    lengths: Floats = np.append(0.0, np.hypot(steps[:, 0], steps[:, 1]).cumsum())
    return lengths


def thin_line(points: Floats, distance: float) -> Floats:
    """Keep the first point, the last point, and a point for each `distance` of a line."""
    # Pillow draws jagged lines through points that are closer than a line is wide.
    if len(points) <= 2:
        return points
    # The number of whole distances from the start grows at each point that is kept.
    mark = (path_lengths(points) / distance).astype(np.int64)
    kept = np.append(True, np.diff(mark) > 0)
    # Without its last point a path would end short of the robot.
    kept[-1] = True
    thinned: Floats = points[kept]
    return thinned


def round_length(limit: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most `limit`."""
    # The slack accepts lengths that rounding has made a little smaller.
    power = 10.0 ** math.floor(math.log10(limit))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= limit * (1.0 + 1e-9))


def encode_png(image: NDArray[np.uint8], comment: str) -> bytes:
    """Encode a picture (height, width, 3) as PNG, with a comment in it."""
    pillow = import_pillow()
    texts = pillow.PngImagePlugin.PngInfo()
    texts.add_text("Comment", comment)
    file = io.BytesIO()
    pillow.Image.fromarray(image).save(file, "PNG", pnginfo=texts)
    return file.getvalue()


def check_picture_size(name: str, size: tuple[int, int]) -> None:
    """Raise ConfigError unless width and height are ints from MIN_SIDE to MAX_SIDE [pixels]."""
    # The size is what a user passed: a single number and texts raise TypeError here.
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
def load_font() -> Any:
    """Return Pillow's own font for texts in fine pixels."""
    return import_pillow().ImageFont.load_default(FINE_SCALE * TEXT_HEIGHT)


def import_pillow() -> Any:
    """Import Pillow with the modules used here. Raises MissingExtraError if it isn't installed."""
    with require_extra("pictures", "pictures"):
        import PIL.Image  # noqa: PLC0415 - optional
        import PIL.ImageDraw  # noqa: PLC0415
        import PIL.ImageFont  # noqa: PLC0415
        import PIL.PngImagePlugin  # noqa: PLC0415
    return PIL

"""ROS maps, as map_server writes them: a YAML of settings and a picture of what is occupied.

The outlines of all occupied pixels become segments along the pixels' edges. Unknown pixels count as
free. Lengths in m, in the frame of the map. `origin` is the lower left corner of the picture.
"""

from __future__ import annotations

import difflib
import io
import math
import warnings
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from acsar_gym.config.section import Length, Section
from acsar_gym.errors import ConfigError, WorldError, require_extra, show_value
from acsar_gym.worlds.world import MAX_OBSTACLES, Floats

Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
PILLOW_FORMATS = ("PPM", "PNG", "BMP", "JPEG")  # formats that Pillow may try. PGM is a PPM for it
MAX_MAP_PIXELS = 4096 * 4096
TOO_LARGE = f"has more than {MAX_MAP_PIXELS:,} pixels: crop or shrink it"
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class MapSettings(Section):
    """The YAML of a map. See http://wiki.ros.org/map_server."""

    model_config = ConfigDict(extra="ignore")

    image: str
    """File of the picture. A relative path starts at the YAML's folder."""
    resolution: Length
    """Size of a pixel [m]."""
    origin: tuple[float, float, float]
    """x, y [m] and yaw [rad] of the lower left corner of the lower left pixel."""
    negate: bool = False
    """Whether white is occupied, instead of black. Mode raw ignores it, as map_server does."""
    occupied_thresh: Share = 0.65
    """A pixel is occupied if its occupancy is above this."""
    free_thresh: Share = 0.196
    """Between this and `occupied_thresh` a pixel is unknown or, in mode scale, partly occupied.
    Neither is an obstacle here."""
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    """In mode raw, pixels are percentages. Those above 100 are unknown."""


def read_settings(data: Mapping[str, Any]) -> MapSettings:
    """Read the settings in a map's YAML. Refuses keys that look misspelt."""
    fields = MapSettings.model_fields
    for key in data:
        # A map may have other keys, so only those that look misspelt are refused.
        similar = difflib.get_close_matches(key[:40], fields, n=1, cutoff=0.8)
        if similar and key not in fields:
            raise WorldError(f"unknown key {show_value(key)}; did you mean {similar[0]!r}?")
    try:
        return MapSettings.model_validate(data)
    except ConfigError as error:
        raise WorldError(str(error)) from error


def map_segments(picture: bytes, config: MapSettings) -> Floats:
    """Compute the outlines of what is occupied.

    Args:
        picture: Content of the picture's file.
        config: Settings of the map.

    Returns:
        Segments (n, 4) in the map's frame [m].

    Raises:
        WorldError: The picture is broken, too large or too detailed.
    """
    levels, shades, opaque = _read_levels(picture)
    mask = occupied_shades(shades, config)[levels] & opaque
    lines = trace_outlines(mask) * config.resolution
    x, y, yaw = config.origin
    cos = math.cos(yaw)
    sin = math.sin(yaw)

    # `origin` turns the picture around its lower left corner and then moves it.
    turned = lines.reshape(-1, 2) @ np.array([[cos, sin], [-sin, cos]])
    moved: Floats = (turned + np.array([x, y])).reshape(-1, 4)
    return moved


def occupied_shades(shades: Floats, config: MapSettings) -> Mask:
    """Which shades, 0 (black) to 1 (white), are obstacles."""
    if config.mode == "raw":
        percent = np.round(shades * 255.0)
        return (percent > 100.0 * config.occupied_thresh) & (percent <= 100.0)
    # Occupancy is darkness, as map_server defines it.
    bright = 1.0 - shades if config.negate else shades
    return 1.0 - bright > config.occupied_thresh


def trace_outlines(mask: Mask) -> Floats:
    """Find the edges between occupied pixels (rows, columns) and others.

    Returns (segments, 4) in pixels from the lower left corner. More than 20,000 raise WorldError.
    """
    filled = np.pad(mask[::-1], 1).astype(np.int8)  # from now on the first row is the lowest

    # An edge is where neighbours differ. Edges in a row become one segment.
    level, first, last = _find_runs(np.diff(filled, axis=0)[:, 1:-1] != 0)
    upright, low, high = _find_runs(np.diff(filled, axis=1)[1:-1].T != 0)
    rows = np.column_stack([first, level, last, level])
    columns = np.column_stack([upright, low, upright, high])
    count = len(rows) + len(columns)
    if count > MAX_OBSTACLES:
        raise WorldError(
            f"its outlines are {count:,} segments, at most {MAX_OBSTACLES:,} can be used: crop it, "
            "remove speckles, or lower its resolution"
        )
    return np.concatenate([rows, columns]).astype(np.float64)


def _find_runs(edges: Mask) -> tuple[Indices, Indices, Indices]:
    """Line, first and one past the last index of every run of true values along lines."""
    steps = np.diff(np.pad(edges, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    lines, firsts = np.nonzero(steps == 1)
    return lines, firsts, np.nonzero(steps == -1)[1]


def _check_size(width: int, height: int) -> None:
    if width * height > MAX_MAP_PIXELS:
        raise WorldError(TOO_LARGE)


def _read_levels(picture: bytes) -> tuple[NDArray[Any], Floats, Mask]:
    """Levels of all pixels, brightness (0 to 1) of each level, and which pixels are opaque."""
    with require_extra("reading a map's picture", "pictures"):
        from PIL import Image  # noqa: PLC0415
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(picture), formats=PILLOW_FORMATS) as image:
                _check_size(*image.size)
                if image.mode.startswith("I"):  # 16 bits, which Pillow would clip, not scale
                    grey = np.clip(np.asarray(image), 0, 65535)
                    return grey, np.arange(65536) / 65535.0, np.ones((1, 1), np.bool_)
                pixels = np.asarray(image.convert("RGBA"))
    except WorldError:
        raise
    except Image.DecompressionBombError as error:
        raise WorldError(TOO_LARGE) from error
    except Exception as error:  # Pillow raises all kinds for broken pictures
        raise WorldError("isn't a sound PGM, PNG, BMP or JPEG picture: save it again") from error

    # The sum of three channels is a level, because a table of 766 levels is faster than
    # comparing floats of each pixel.
    levels = pixels[:, :, :3].sum(axis=2, dtype=np.uint16)
    return levels, np.arange(766) / 3.0 / 255.0, pixels[:, :, 3] == 255

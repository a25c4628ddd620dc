"""ROS maps, as map_server writes them: a YAML of settings and a picture of what is occupied.

The outlines of all occupied pixels become segments along the pixels' edges. Unknown pixels count as
free. Lengths in m, in the frame of the map; `origin` is the lower left corner of the picture.
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

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, MissingExtraError, WorldError, show_value
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES, Floats

Mask = NDArray[np.bool_]
PICTURE_SUFFIXES = (".pgm", ".png", ".pbm", ".ppm", ".bmp", ".jpg", ".jpeg")
PILLOW_FORMATS = ("PPM", "PNG", "BMP", "JPEG")  # formats that Pillow may try; PGM is a PPM for it
MAX_MAP_PIXELS = 4096 * 4096
UNSOUND_PICTURE = "isn't a sound PGM, PNG, BMP or JPEG picture: save it again"
Share = Annotated[float, Field(strict=True, ge=0.0, le=1.0)]
Coordinate = Annotated[float, Field(strict=True, ge=-MAX_COORDINATE, le=MAX_COORDINATE)]


class MapSettings(Section):
    """The YAML of a map; http://wiki.ros.org/map_server describes it."""

    model_config = ConfigDict(extra="ignore")

    image: Annotated[str, Field(min_length=1, max_length=1000)]
    """File of the picture; a relative path starts at the YAML's folder."""
    resolution: Annotated[float, Field(strict=True, gt=0.0, le=100.0)]
    """Size of a pixel [m]."""
    origin: tuple[Coordinate, Coordinate, Annotated[float, Field(strict=True)]]
    """x, y [m] and yaw [rad] of the lower left corner of the lower left pixel."""
    negate: bool = False
    """Whether white is occupied, instead of black; as in map_server, not in mode raw."""
    occupied_thresh: Share = 0.65
    """A pixel is occupied if its occupancy is above this."""
    free_thresh: Share = 0.196
    """Between this and `occupied_thresh` a pixel is unknown or, in mode scale, partly occupied;
    neither is an obstacle here."""
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    """In mode raw, pixels are percentages; those above 100 are unknown."""


def read_settings(data: Mapping[str, Any]) -> MapSettings:
    """Read the settings in a map's YAML; keys that look misspelt are refused."""
    fields = MapSettings.model_fields
    for key in (key for key in data if isinstance(key, str) and key not in fields):
        if near := difflib.get_close_matches(key[:40], fields, n=1, cutoff=0.8):
            raise WorldError(f"unknown key {show_value(key)}; did you mean {near[0]!r}?")
    missing = [key for key in fields if fields[key].is_required() and data.get(key) is None]
    if missing:
        raise WorldError(f"{', '.join(missing)}: is missing: add it")
    try:
        return MapSettings.model_validate(data)
    except ConfigError as error:
        raise WorldError(str(error)) from error


def map_segments(picture: bytes, config: MapSettings) -> Floats:
    """Compute the outlines of what is occupied, (segments, 4) in the map's frame [m].

    WorldError for a picture that is broken, too large or too detailed.
    """
    levels, shades, opaque = _read_levels(picture)
    mask = occupied_shades(shades, config)[levels]
    lines = trace_outlines(mask if opaque is None else mask & opaque) * config.resolution
    x, y, yaw = config.origin
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = lines.reshape(-1, 2) @ np.array([[cos, sin], [-sin, cos]])
    moved: Floats = (turned + np.array([x, y])).reshape(-1, 4)
    return moved


def occupied_shades(shades: Floats, config: MapSettings) -> Mask:
    """Which shades, 0 (black) to 1 (white) and NaN where transparent, are obstacles."""
    bright = 1.0 - shades if config.negate else shades
    percent = np.round(shades * 255.0)
    raw: Mask = (percent > 100.0 * config.occupied_thresh) & (percent <= 100.0)
    dark: Mask = 1.0 - bright > config.occupied_thresh
    return raw if config.mode == "raw" else dark


def trace_outlines(mask: Mask) -> Floats:
    """Find the edges between occupied pixels (rows, columns) and others.

    Returns (segments, 4) in pixels from the lower left corner; WorldError for more than 20,000.
    """
    filled = np.pad(mask[::-1], 1).astype(np.int8)  # from now on the first row is the lowest
    level, left, right = _find_runs(np.diff(filled, axis=0)[:, 1:-1] != 0)
    upright, low, high = _find_runs(np.diff(filled, axis=1)[1:-1].T != 0)
    if len(level) + len(upright) > MAX_OBSTACLES:
        raise WorldError(
            f"its outlines are {len(level) + len(upright):,} segments, at most {MAX_OBSTACLES:,} "
            "can be used: crop it, remove speckles, or lower its resolution"
        )
    rows = np.column_stack([left, level, right, level])
    columns = np.column_stack([upright, low, upright, high])
    return np.concatenate([rows, columns]).astype(np.float64)


def _find_runs(edges: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Line, first and one past the last index of every run of true values along lines."""
    steps = np.diff(np.pad(edges, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    lines, firsts = np.nonzero(steps == 1)
    return lines, firsts, np.nonzero(steps == -1)[1]


def _read_levels(picture: bytes) -> tuple[NDArray[Any], Floats, Mask | None]:
    """Levels of all pixels, brightness (0 to 1) of each level, and which pixels are opaque."""
    try:
        from PIL import Image  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("reading a map's picture", "pictures") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(picture), formats=PILLOW_FORMATS) as image:
                _check_size(*image.size)
                if image.mode.startswith("I"):  # 16 bits, which Pillow would clip, not scale
                    grey = np.clip(np.asarray(image), 0, 65535)
                    return grey, np.arange(65536) / 65535.0, None
                if image.mode in ("1", "L"):
                    return np.asarray(image.convert("L")), np.arange(256) / 255.0, None
                pixels = np.asarray(image.convert("RGBA"))
    except WorldError:
        raise
    except Image.DecompressionBombError as error:
        raise WorldError(f"has more than {MAX_MAP_PIXELS:,} pixels: crop or shrink it") from error
    except Exception as error:  # Pillow raises all kinds for broken pictures
        raise WorldError(UNSOUND_PICTURE) from error
    levels = pixels[:, :, 0].astype(np.uint16) + pixels[:, :, 1] + pixels[:, :, 2]
    return levels, np.arange(766) / 3.0 / 255.0, pixels[:, :, 3] == 255


def _check_size(width: int, height: int) -> None:
    if width * height > MAX_MAP_PIXELS:
        raise WorldError(
            f"is {width:,} x {height:,} pixels, more than {MAX_MAP_PIXELS:,}: crop or shrink it"
        )

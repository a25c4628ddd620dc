"""From an RPLIDAR's bytes to complete turns, and from a turn to the ranges of a scan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import LidarConfig
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]

NODE = 5
"""Bytes of a measurement."""
FEWEST, MOST = 36, 10_000
"""Measurements of a turn; anything else is none."""
UNEVEN = 15.0
"""Angles of a turn grow evenly, but for this much; if not, bytes were lost [deg]."""
SURE = 8
"""Measurements in a row that prove a start flag: what a lost byte has shifted fails sooner."""
NEIGHBOUR = 0.75
"""A direction takes a measurement this near, in parts of the sensor's own step."""

Turn = tuple[Floats, Floats]
"""Bearings [rad], counter-clockwise from the sensor's zero, and distances [m], 0: not measured."""


class Turns:
    """Bytes in, complete turns out. `library` is lds2d.drivers.rplidar.

    A turn in which a byte was lost is dropped as a whole: a hole in it would read as free space.
    """

    def __init__(self, library: Any) -> None:
        self._library = library
        self.forget()

    def forget(self) -> None:
        """Drop what has come so far, and wait for the beginning of a turn."""
        self._rest = b""
        self._drop()

    def _drop(self) -> None:
        self._points: list[Any] | None = None
        self._ended: list[Any] | None = None

    def feed(self, data: bytes) -> list[Turn]:
        """The turns that `data` completes: each goes from one start flag to the next."""
        buffer, at, turns = self._rest + data, 0, []
        while len(buffer) - at >= NODE:
            node = buffer[at : at + NODE]
            if self._library.node_ok(node):
                turns += self._take(*self._library.parse_node(node))
                at += NODE
            else:
                self._drop()
                at += 1
        self._rest = buffer[at:]
        return turns

    def _take(self, point: Any, starts: bool) -> list[Turn]:
        """The turn that this measurement completes, if it does."""
        if starts:
            self._ended, self._points = self._points, []
        if self._points is None:
            return []
        self._points.append(point)
        if len(self._points) > MOST:
            self._drop()
        elif len(self._points) == SURE and self._ended is not None:
            return _turn(self._ended)
        return []


def _turn(points: list[Any]) -> list[Turn]:
    """The points as a turn, or none where some are missing."""
    if len(points) < FEWEST:
        return []
    angles = np.array([point.angle_deg for point in points], dtype=np.float64)
    distances = np.array([point.dist_mm for point in points], dtype=np.float64) / 1000.0
    return [(-np.radians(angles), distances)] if _even(angles, distances > 0.0) else []


def _even(angles: Floats, measured: NDArray[np.bool_]) -> bool:
    """Whether the angles [deg] grow by a full turn; those of missed measurements mean nothing."""
    (places,) = np.nonzero(measured)
    if not len(places):
        return True
    expected = (places - places[0]) * 360.0 / len(angles)
    off = (angles[places] - angles[places[0]] - expected + 180.0) % 360.0 - 180.0
    return bool(np.abs(off).max() <= UNEVEN)


def binned(bearings: Floats, distances: Floats, lidar: LidarConfig) -> Floats:
    """Ranges (rays,) [m] of one turn: bearings [rad], counter-clockwise, and distances [m].

    Each direction takes the measurement next to it, as a simulated ray sees what is exactly there.
    """
    spec = RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)
    spacing = 2.0 * math.pi / max(len(bearings), 1)
    measured = distances > 0.0
    ranges = np.full(spec.rays, np.inf)
    if measured.any():
        seen, found = _wrapped(bearings[measured]), distances[measured]
        ranges = _next_to(spec.angles(), seen, found, NEIGHBOUR * spacing)
    clamped: Floats = np.clip(ranges, lidar.min_range, lidar.max_range)
    return clamped


def _next_to(directions: Floats, bearings: Floats, distances: Floats, reach: float) -> Floats:
    """The distance whose bearing is next to each direction, inf where none is within `reach`."""
    order = np.argsort(bearings)
    bearings, distances = bearings[order], distances[order]
    right = np.searchsorted(bearings, _wrapped(directions)) % len(bearings)
    both = np.stack((right - 1, right))
    off = np.abs(_wrapped(bearings[both] - directions))
    nearest = off.argmin(axis=0), np.arange(len(directions))
    return np.where(off[nearest] <= reach, distances[both[nearest]], np.inf)


def _wrapped(angles: Floats) -> Floats:
    """The same angles within -pi to pi [rad]."""
    return (angles + math.pi) % (2.0 * math.pi) - math.pi

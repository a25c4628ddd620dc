"""Decode an RPLIDAR's bytes into complete revolutions, and these into the ranges of a scan."""

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
"""A revolution has at least 36 and at most 10,000 measurements; any other is dropped."""
UNEVEN = 15.0
"""Angles of a revolution grow evenly, up to this deviation; otherwise bytes were lost [deg]."""
SURE = 8
"""Valid measurements in a row that prove a start flag: bytes shifted by a loss are invalid
sooner."""
NEIGHBOUR = 0.75
"""A ray takes a measurement that is this near, in parts of the angle between two measurements."""

Turn = tuple[Floats, Floats]
"""Bearings [rad], counter-clockwise from the LiDAR's zero, and distances [m], 0 where nothing
was measured."""


class Turns:
    """Decodes bytes into complete revolutions. `library` is lds2d.drivers.rplidar.

    A revolution in which bytes were lost is dropped: a gap in it would look like free space.
    """

    def __init__(self, library: Any) -> None:
        self._library = library
        self.forget()

    def forget(self) -> None:
        """Drop all bytes so far, and wait for the beginning of a revolution."""
        self._rest = b""
        self._drop()

    def _drop(self) -> None:
        """Drop the measurements so far."""
        self._points: list[Any] | None = None
        self._ended: list[Any] | None = None

    def feed(self, data: bytes) -> list[Turn]:
        """Return the revolutions that `data` completes.

        Each goes from one start flag to the next.
        """
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
        """Add a measurement; returns the revolution that it completes, if it does."""
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
    """A revolution of these points; empty where some are missing."""
    if len(points) < FEWEST:
        return []
    angles = np.array([point.angle_deg for point in points], dtype=np.float64)
    distances = np.array([point.dist_mm for point in points], dtype=np.float64) / 1000.0
    return [(-np.radians(angles), distances)] if _even(angles, distances > 0.0) else []


def _even(angles: Floats, measured: NDArray[np.bool_]) -> bool:
    """Whether the angles [deg] grow evenly by a full turn.

    Missed measurements have no valid angle.
    """
    (places,) = np.nonzero(measured)
    if not len(places):
        return True
    expected = (places - places[0]) * 360.0 / len(angles)
    off = (angles[places] - angles[places[0]] - expected + 180.0) % 360.0 - 180.0
    return bool(np.abs(off).max() <= UNEVEN)


def binned(bearings: Floats, distances: Floats, lidar: LidarConfig, gap: float = 0.0) -> Floats:
    """Compute the ranges of a scan from one revolution.

    Each ray takes the measurement whose bearing is next to it, while a simulated ray has exactly
    its
    own bearing.

    Args:
        bearings: counter-clockwise [rad].
        distances: of the same shape [m]; 0 where nothing was measured.
        lidar: configuration of the rays.
        gap: width of the gaps that a moving robot leaves between bearings [rad]. A ray in a gap
            takes what is next to it; that may be a bearing where nothing was measured.

    Returns:
        (rays,) [m], within min_range to max_range.
    """
    spec = RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)
    spacing = 2.0 * math.pi / max(len(bearings), 1)
    measured = distances > 0.0
    ranges = np.full(spec.rays, np.inf)
    if measured.any():
        seen, rays = _wrapped(bearings), spec.angles()
        ranges = _next_to(rays, seen[measured], distances[measured], NEIGHBOUR * spacing)
        if gap:
            around = _next_to(rays, seen, np.where(measured, distances, np.inf), gap)
            ranges = np.where(np.isfinite(ranges), ranges, around)
    clamped: Floats = np.clip(ranges, lidar.min_range, lidar.max_range)
    return clamped


def _next_to(directions: Floats, bearings: Floats, distances: Floats, reach: float) -> Floats:
    """The distance whose bearing is next to each direction.

    Inf where none is within `reach` [rad].
    """
    order = np.argsort(bearings)
    bearings, distances = bearings[order], distances[order]
    right = np.searchsorted(bearings, _wrapped(directions)) % len(bearings)
    both = np.stack((right - 1, right))
    off = np.abs(_wrapped(bearings[both] - directions))
    nearest = off.argmin(axis=0), np.arange(len(directions))
    return np.where(off[nearest] <= reach, distances[both[nearest]], np.inf)


def _wrapped(angles: Floats) -> Floats:
    """Wrap angles to [-pi, pi) [rad]."""
    return (angles + math.pi) % (2.0 * math.pi) - math.pi

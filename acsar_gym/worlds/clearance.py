"""Exact distances from points and line segments to the obstacles of a world, in NumPy.

Lengths in m, in the frame of the world. The work is N x obstacles; it is done in chunks, so memory
stays at a few MB for any N.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.worlds.world import World

Floats = NDArray[np.float64]
CHUNK = 2**14
"""Distances that are computed at a time."""


def clearance(points: ArrayLike, world: World) -> Floats:
    """Compute distances of points to the nearest obstacle.

    Args:
        points: (N, 2) [m].
        world: with the obstacles.

    Returns:
        (N,) [m]: negative inside a circle, zero on a segment, inf without obstacles.

    Raises:
        ValueError: for points of another shape.
    """
    places = _pairs(points)
    return _chunked(lambda rows: _of_points(places[rows], world), len(places), world)


def segment_clearance(a: ArrayLike, b: ArrayLike, world: World) -> Floats:
    """Compute the least distance of straight lines to any obstacle.

    Args:
        a: beginnings, (N, 2) [m].
        b: ends, (N, 2) [m].
        world: with the obstacles.

    Returns:
        (N,) [m]: minus the depth where a line enters a circle, zero where it touches or crosses
        a segment, inf without obstacles.

    Raises:
        ValueError: for other shapes.
    """
    starts, ends = _pairs(a), _pairs(b)
    if len(starts) != len(ends):
        raise ValueError(f"{len(starts)} starts and {len(ends)} ends of pieces")
    return _chunked(lambda rows: _of_pieces(starts[rows], ends[rows], world), len(starts), world)


def _pairs(points: ArrayLike) -> Floats:
    """Check and convert points to (N, 2)."""
    array = np.asarray(points, np.float64)
    if array.size == 0:
        return np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"points must be of shape (N, 2), not {array.shape}")
    return array


def _chunked(distances: Callable[[slice], Floats], count: int, world: World) -> Floats:
    """Distances of so many rows, computed in chunks."""
    rows = max(1, CHUNK // max(1, world.obstacles))
    result = np.full(count, np.inf)
    if world.obstacles:
        for first in range(0, count, rows):
            result[first : first + rows] = distances(slice(first, first + rows))
    return result


def _of_points(points: Floats, world: World) -> Floats:
    """`clearance` of one chunk, (N,)."""
    p = points.T[..., None]
    to_circles = _lengths(p - world.circles.T[:2, None]) - world.circles[:, 2]
    to_segments = _to_pieces(p, world.segments.T[:2, None], world.segments.T[2:, None])
    return _least(to_circles, to_segments)


def _of_pieces(starts: Floats, ends: Floats, world: World) -> Floats:
    """`segment_clearance` of one chunk, (N,)."""
    a, b = starts.T[..., None], ends.T[..., None]
    c, d = world.segments.T[:2, None], world.segments.T[2:, None]
    to_circles = _to_pieces(world.circles.T[:2, None], a, b) - world.circles[:, 2]
    # Two segments that don't cross are nearest at one of their four ends.
    of_ends = np.minimum(_to_pieces(a, c, d), _to_pieces(b, c, d))
    of_their_ends = np.minimum(_to_pieces(c, a, b), _to_pieces(d, a, b))
    to_segments = np.where(_cross(a, b, c, d), 0.0, np.minimum(of_ends, of_their_ends))
    return _least(to_circles, to_segments)


def _least(*distances: Floats) -> Floats:
    """The least value of every row of several arrays (N, obstacles)."""
    least: Floats = np.concatenate(distances, axis=1).min(axis=1)
    return least


# In the functions below the first axis of a vector is x and y: NumPy is twice as fast that way.


def _to_pieces(points: Floats, starts: Floats, ends: Floats) -> Floats:
    """Distance of points (2, ...) to the lines from `starts` to `ends` (2, ...)."""
    along, offset = ends - starts, points - starts
    square = _dot(along, along)
    share = np.clip(_dot(offset, along) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    return np.where(share < 1.0, _lengths(offset - share * along), _lengths(points - ends))


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> NDArray[np.bool_]:
    """Whether the lines a-b and c-d cross; touching and overlapping don't count."""
    apart_one = _side(a, b, c) * _side(a, b, d)
    apart_other = _side(c, d, a) * _side(c, d, b)
    crossing: NDArray[np.bool_] = (apart_one < 0.0) & (apart_other < 0.0)
    return crossing


def _side(a: Floats, b: Floats, c: Floats) -> Floats:
    """Side of the line from a to b on which c is: 1 left, -1 right, 0 on it."""
    (abx, aby), (acx, acy) = b - a, c - a
    side: Floats = np.sign(abx * acy - aby * acx)
    return side


def _dot(one: Floats, other: Floats) -> Floats:
    """Dot product along the first axis."""
    product: Floats = one[0] * other[0] + one[1] * other[1]
    return product


def _lengths(vectors: Floats) -> Floats:
    """Lengths of vectors along the first axis."""
    lengths: Floats = np.sqrt(_dot(vectors, vectors))
    return lengths

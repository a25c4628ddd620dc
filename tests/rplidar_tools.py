"""An RPLIDAR's driver, and what a sensor in another process should make it see."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from lidar_tools import Floats, room
from serial_tools import Emulated, wait_until

from acsar_gym.sensors.lidar import Lidar, Scan
from acsar_gym.sensors.rplidar import RplidarLidar
from acsar_gym.worlds import Scene

MILLIMETRES = 0.002
"""What the wire and lds2d round away [m]."""

MAX = 5.0

Start = Callable[..., Emulated]

Open = Callable[..., RplidarLidar]


def reset(lidar: Lidar) -> None:
    lidar.reset(Scene(), np.random.default_rng(0))


def measure(lidar: RplidarLidar) -> Floats:
    reset(lidar)
    ranges = lidar.scan().ranges
    lidar.close()
    return ranges


def directions(rays: int, field: float = 2.0 * math.pi) -> Floats:
    """As the contract says: from -field / 2, and a full turn has none twice."""
    step = field / (rays if field > 6.28 else max(rays - 1, 1))
    return -field / 2.0 + step * np.arange(rays, dtype=np.float64)


def shows_the_room(ranges: Floats, field: float = 2.0 * math.pi) -> bool:
    """Whether each direction has the wall where the measurement next to it met it.

    Of two measurements just as near either will do.
    """
    bearings = wrapped(-np.radians(np.arange(360.0)))
    off = np.abs(wrapped(directions(len(ranges), field)[:, None] - bearings))
    next_to_it = off <= off.min(axis=1, keepdims=True) + 1e-6
    low = np.where(next_to_it, room(bearings), np.inf).min(axis=1)
    high = np.where(next_to_it, room(bearings), -np.inf).max(axis=1)
    return bool(((ranges >= low - MILLIMETRES) & (ranges <= high + MILLIMETRES)).all())


def wrapped(angles: Floats) -> Floats:
    return (angles + math.pi) % (2.0 * math.pi) - math.pi


def newer(lidar: RplidarLidar, than: float) -> Scan:
    """The first turn after that."""
    wait_until(lambda: lidar.scan().stamp > than, "a newer turn")
    return lidar.scan()

"""A serial LiDAR, and what a sensor in another process should make it see."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from lidar_tools import Floats, room
from serial_tools import Emulated

from acsar_gym.config import RobotConfig
from acsar_gym.lidar.contract import Lidar
from acsar_gym.lidar.drivers import find_drivers
from acsar_gym.lidar.scan import Revolution
from acsar_gym.lidar.serial import SerialLidar
from acsar_gym.testing import wait_until
from acsar_gym.worlds import Scene

ROUNDED = 0.003
"""What wires and lds2d round away [m]."""

MODELS = ("rplidar", "ld06", "ydlidar_x4")
"""A LiDAR that is asked for turns, another that always sends them, and a third that splits them."""

Start = Callable[..., Emulated]
Open = Callable[..., SerialLidar]


def open_serial(
    device: Emulated | str, model: str = "rplidar", timeout: float = 20.0
) -> SerialLidar:
    """A closed LiDAR on a device."""
    config = RobotConfig.preset("acsar").with_(lidar={"timeout": timeout}, reconnect_timeout=0.5)
    name = device if isinstance(device, str) else device.device
    return SerialLidar(name, find_drivers()[model], config, time.monotonic)


def reset(lidar: Lidar) -> None:
    lidar.reset(Scene(), np.random.default_rng(0))


def measure(lidar: SerialLidar) -> Revolution:
    reset(lidar)
    turn = lidar.scan()
    lidar.close()
    return turn


def newer(lidar: SerialLidar, than: float) -> Revolution:
    """The first turn after that."""
    wait_until(lambda: lidar.scan().stamp > than, "a newer turn")
    return lidar.scan()


def shows_the_room(turn: Revolution) -> bool:
    """Whether each measurement is of the wall at its bearing, and together they go all around."""
    gaps = np.diff(np.sort(turn.bearings))
    near = np.stack([room(turn.bearings + off) for off in np.radians((-0.1, 0.0, 0.1))])
    return bool(
        len(turn.bearings) == len(turn.distances) == len(turn.times)
        and (np.abs(turn.bearings) <= math.pi).all()
        and np.degrees(gaps.max()) < 5.0
        and (turn.distances >= near.min(axis=0) - ROUNDED).all()
        and (turn.distances <= near.max(axis=0) + ROUNDED).all()
        and (np.diff(turn.times) >= 0.0).all()
        and turn.times[-1] == turn.stamp
    )


def show_turned(turn: Revolution) -> Floats:
    """The angle between each measurement and the next [rad]."""
    return (np.diff(turn.bearings) + math.pi) % (2.0 * math.pi) - math.pi

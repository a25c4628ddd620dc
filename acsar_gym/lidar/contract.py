"""The contract of a LiDAR, and what is checked of the revolutions that it measures."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.scan import FULL_TURN, MAX_DISTANCE, MAX_STAMP, Revolution
from acsar_gym.worlds import Scene

MAX_AHEAD = 60.0
"""A revolution may end so long after the time on the link's clock, and reconnect_timeout: that
stands still where the link is recorded and a device starts. One further ahead has another clock
[s]."""


REVOLUTION_BOUNDS = (
    (-FULL_TURN, FULL_TURN, "rad"),
    (0.0, MAX_DISTANCE, "m"),
    (-MAX_STAMP, MAX_STAMP, "s"),
    (-MAX_STAMP, MAX_STAMP, "s"),
)


class Lidar(Protocol):
    """A LiDAR, simulated or real. Times are on the clock of the robot's link.

    One that must see every tick, as the simulated one does, has a method `poll(truth, now)` as
    well; see `Sensor.poll`.
    """

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed.

        Args:
            scene: the world, and the robot's start in it.
            rng: for the noise.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
        """

    def scan(self) -> Revolution:
        """Return the newest complete revolution; doesn't wait for one.

        Raises:
            LidarError: the device is gone. That a revolution is older than the configured time-out
                is found out by `LidarSensor`.
        """

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""


def check_revolution(made: Revolution, source: str) -> Revolution:
    """Check what a LiDAR measured before compiled loops get it.

    Returns:
        The same in arrays of float64.

    Raises:
        LidarError: it isn't a Revolution, or one of its fields is none of finite numbers, or out
            of the range that a recording can have.
    """
    fix = "must be an acsar_gym.lidar.scan.Revolution, 0 where no distance was measured"
    try:
        bearings, distances, times = (np.ascontiguousarray(made[k], np.float64) for k in range(3))
        checked = Revolution(bearings, distances, times, float(made[3]))
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise LidarError(f"{source}.scan() gave {show_value(made)}", fix) from error
    for name, values, (low, high, unit) in zip(
        Revolution._fields, checked, REVOLUTION_BOUNDS, strict=True
    ):
        shape = () if name == "stamp" else (len(bearings),)
        numbers = np.asarray(values)
        if numbers.shape != shape or not ((low <= numbers) & (numbers <= high)).all():
            raise LidarError(
                f"{source}.scan(): {name} = {show_value(numbers.tolist())}: must be "
                f"{len(bearings) if shape else 1} from {low:.4g} to {high:.4g} {unit}",
                fix,
            )
    return checked


def check_age(source: str, revolution: Revolution, now: float, config: RobotConfig) -> None:
    """Check that a LiDAR still measures, by the clock of the robot's link.

    Raises:
        LidarError: the revolution is older than lidar.timeout, or further ahead than it can be.
    """
    newest, timeout = revolution.stamp, config.lidar.timeout
    if now - newest > timeout:
        raise LidarError(
            f"{source}: no complete turn for {now - newest:.2f} s (lidar.timeout = {timeout:g} s)",
            "check its power and that its head turns freely, then reset",
        )
    newest = max(newest, revolution.times.max(initial=newest))
    if newest - now > MAX_AHEAD + config.reconnect_timeout:
        raise LidarError(
            f"{source}: measured {newest - now:g} s after now by the link's clock",
            "its times and stamp must be on that clock: see acsar_gym.Link.clock",
        )

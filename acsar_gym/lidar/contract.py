"""The contract of a LiDAR, and checks of the revolutions that it measures."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.scan import FULL_TURN, MAX_DISTANCE, MAX_STAMP, Revolution
from acsar_gym.worlds import Scene

MAX_AHEAD = 60.0
"""A revolution may end this time, and reconnect_timeout, after now by the link's clock, which is
still while a device of a recorded link starts. A revolution that is further ahead has another clock
[s]."""
BOUNDS = {
    "bearings": (-FULL_TURN, FULL_TURN, "rad"),
    "distances": (0.0, MAX_DISTANCE, "m"),
    "times": (-MAX_STAMP, MAX_STAMP, "s"),
    "stamp": (-MAX_STAMP, MAX_STAMP, "s"),
}
"""Least and largest number of each field of a Revolution, and its unit."""


class Lidar(Protocol):
    """A LiDAR, simulated or real. Times are on the clock of the robot's link.

    A LiDAR that must see every tick, as the simulated LiDAR does, also has a method
    `poll(truth, now)`: see `Sensor.poll`.
    """

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Start an episode. Opens a device that is closed.

        Args:
            scene: World, and the robot's start in it.
            rng: Generator for the noise.

        Raises:
            LidarError: The device can't be opened, or doesn't measure.
        """

    def scan(self) -> Revolution:
        """Return the newest complete revolution, without waiting.

        Raises:
            LidarError: The device is gone. `LidarSensor` checks the age of the revolution.
        """

    def close(self) -> None:
        """Stop the motor and close the device. Idempotent."""


def check_revolution(revolution: Revolution, source: str) -> Revolution:
    """Check what a user's LiDAR measured, before compiled loops get it.

    Returns:
        The same in arrays of float64.

    Raises:
        LidarError: It isn't a Revolution, or a field isn't made of numbers that a recording can
            have.
    """
    fix = "must be an acsar_gym.lidar.scan.Revolution, 0 where no distance was measured"
    try:
        bearings, distances, times = np.array(revolution[:3], np.float64)
        (_,) = bearings.shape  # ValueError for anything but a list of numbers
        checked = Revolution(bearings, distances, times, float(revolution[3]))
    except (TypeError, ValueError, LookupError) as error:
        raise LidarError(f"{source}.scan() gave {show_value(revolution)}", fix) from error

    # Arrays that differ in length were refused above. NaN fails both comparisons.
    for name, (low, high, unit) in BOUNDS.items():
        values = np.asarray(getattr(checked, name))
        if not ((low <= values) & (values <= high)).all():
            raise LidarError(
                f"{source}.scan(): {name} = {show_value(values.tolist())}: must be "
                f"from {low:.4g} to {high:.4g} {unit}",
                fix,
            )
    return checked


def check_age(revolution: Revolution, now: float, source: str, config: RobotConfig) -> None:
    """Check that a LiDAR still measures, by the clock of the robot's link.

    Raises:
        LidarError: The revolution is older than lidar.timeout, or too far ahead.
    """
    # Times of another clock are far behind or far ahead.
    age = now - revolution.stamp
    timeout = config.lidar.timeout
    if age > timeout:
        raise LidarError(
            f"{source}: no complete turn for {age:.2f} s (lidar.timeout = {timeout:g} s)",
            "check its power and that its head turns freely, then reset",
        )
    ahead = revolution.times.max(initial=revolution.stamp) - now
    if ahead > MAX_AHEAD + config.reconnect_timeout:
        raise LidarError(
            f"{source}: measured {ahead:g} s after now by the link's clock",
            "its times and stamp must be on that clock: see acsar_gym.Link.clock",
        )

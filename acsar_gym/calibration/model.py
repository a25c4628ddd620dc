"""What odometry says of a run with given radii and separation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from acsar_gym.calibration.runs import Floats, Run
from acsar_gym.config import RobotConfig

ROUGHNESS = 2e-4
"""Standard deviation of odometry, as a share of the way of each side: encoders, printed digits."""


SKID = 1e-3
"""Standard deviation of the multiplier from run to run, as a share: it depends a little on speed
and turn radius."""


class Geometry(NamedTuple):
    """The three numbers that odometry needs."""

    radius: float
    """Mean of the left and right wheels' radii [m]."""
    ratio: float
    """Right radius less left radius, as a share of the mean."""
    multiplier: float
    """wheel_separation_multiplier."""

    @property
    def left(self) -> float:
        """Radius of the left wheels [m]."""
        return self.radius * (1.0 - self.ratio / 2.0)

    @property
    def right(self) -> float:
        """Radius of the right wheels [m]."""
        return self.radius * (1.0 + self.ratio / 2.0)


def configured(config: RobotConfig) -> Geometry:
    """The geometry that a robot is configured with."""
    left, right = config.left_wheel_radius_multiplier, config.right_wheel_radius_multiplier
    mean = (left + right) / 2.0
    return Geometry(
        config.wheel_radius * mean, (right - left) / mean, config.wheel_separation_multiplier
    )


def end_pose(wheels: Floats, geometry: Geometry, separation: float) -> tuple[float, float, float]:
    """Integrate wheel angles exactly, as arcs.

    Args:
        wheels: (n, 2), angles of the left and right wheels since the start [rad].
        geometry: radii and multiplier.
        separation: wheel_separation [m].

    Returns:
        x [m], y [m] and theta [rad], full turns included, in the frame of the start.
    """
    moved = np.diff(wheels, axis=0, prepend=0.0) * (geometry.left, geometry.right)
    way = (moved[:, 0] + moved[:, 1]) / 2.0
    turned = (moved[:, 1] - moved[:, 0]) / (separation * geometry.multiplier)
    middle = np.cumsum(turned) - turned / 2.0
    chord = way * np.sinc(turned / (2.0 * math.pi))
    x, y = (chord * np.cos(middle)).sum(), (chord * np.sin(middle)).sum()
    return float(x), float(y), float(turned.sum())


def predicted(run: Run, geometry: Geometry, separation: float) -> list[float]:
    """What each reading of a run should be by odometry [m, rad]."""
    x, y, theta = end_pose(run.wheels, geometry, separation)
    values = {"distance": math.hypot(x, y), "aside": y, "x": x, "y": y, "heading": theta}
    return [values[reading.kind] for reading in run.readings]


def way(run: Run, radius: float) -> float:
    """Mean of the distances that the left and the right wheels rolled in a run [m]."""
    return float(np.abs(np.diff(run.wheels, axis=0)).sum()) * radius / 2.0


def sigmas(run: Run, geometry: Geometry, separation: float) -> list[float]:
    """Standard deviation of reading less odometry for each reading of a run [m, rad]."""
    rough = ROUGHNESS * way(run, geometry.radius)
    arm = separation * geometry.multiplier / 2.0
    skid = SKID * abs(end_pose(run.wheels, geometry, separation)[2])
    return [
        math.hypot(reading.sigma, rough / arm, skid)
        if reading.kind == "heading"
        else math.hypot(reading.sigma, rough)
        for reading in run.readings
    ]


def differences(runs: Sequence[Run], geometry: Geometry, separation: float) -> Floats:
    """Readings less odometry of all runs [m, rad], (readings,)."""
    return np.array(
        [
            reading.value - told
            for run in runs
            for reading, told in zip(
                run.readings, predicted(run, geometry, separation), strict=True
            )
        ]
    )

"""Ground truth of a simulation."""

from __future__ import annotations

from typing import NamedTuple

from acsar_gym.worlds import Pose
from acsar_gym.worlds.crowd import Crowd


class GroundTruth(NamedTuple):
    """What only a simulator knows, in the frame of the world.

    It is never part of an observation.
    """

    pose: Pose = (0.0, 0.0, 0.0)
    """x [m], y [m], theta [rad]."""
    twist: tuple[float, float] = (0.0, 0.0)
    """Forward speed [m/s], yaw rate [rad/s]."""
    contact: bool = False
    """Whether the robot has touched an obstacle since the reset. Checked at the end of every
    tick."""
    crowd: Crowd | None = None
    """The movers around the robot. None without movers."""

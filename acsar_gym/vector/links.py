"""What a sensor of a batch can know of its robot's link: ground truth, time and scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.errors import LinkError
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.pcg import Generators
from acsar_gym.worlds import Scene, World

Floats = NDArray[np.float64]
Robots = NDArray[np.int64]
"""Indices of robots in the batch."""


class Truths(NamedTuple):
    """The ground truth of some robots, one row each, in the frames of their worlds."""

    pose: Floats
    """(robots, 3): x [m], y [m], theta [rad]."""
    twist: Floats
    """(robots, 2): forward speed [m/s], yaw rate [rad/s]."""
    contact: NDArray[np.bool_]
    """(robots,): whether the robot has touched an obstacle since the reset."""


class View:
    """What sensors may know of all robots of a batch. `random` are the robots' generators."""

    def __init__(
        self, state: Floats, random: Generators, dt: float, worlds: Sequence[World]
    ) -> None:
        self.random = random
        self._state, self._dt, self._worlds = state, dt, worlds

    def truths(self, robots: Robots) -> Truths:
        """Ground truth of these robots, in the frames of their worlds."""
        s = self._state[:, robots]
        cos, sin = s[layout.START_COS], s[layout.START_SIN]
        x = s[layout.START_X] + cos * s[layout.X] - sin * s[layout.Y]
        y = s[layout.START_Y] + sin * s[layout.X] + cos * s[layout.Y]
        theta = s[layout.START_THETA] + s[layout.THETA]
        theta -= layout.TURN * np.rint(theta / layout.TURN)
        ahead = s[layout.VX] * np.cos(s[layout.THETA]) + s[layout.VY] * np.sin(s[layout.THETA])
        twist = np.column_stack([ahead, s[layout.RATE]])
        return Truths(np.column_stack([x, y, theta]), twist, s[layout.CONTACT] > 0.0)

    def now(self, robots: Robots) -> Floats:
        """Simulated time since these robots' links were reset [s], (robots,)."""
        time: Floats = self._state[layout.LOOPS, robots] * self._dt
        return time

    def scenes(self, robots: Robots) -> list[Scene]:
        """World, start and goal of these robots' episodes, in the frames of the worlds."""
        s = self._state[:, robots]
        rows = [layout.START_X, layout.START_Y, layout.START_THETA, layout.GOAL_X, layout.GOAL_Y]
        worlds = s[layout.WORLD].astype(np.int64).tolist()
        scenes = []
        for number, (x, y, theta, ahead, left) in zip(worlds, s[rows].T.tolist(), strict=True):
            cos, sin = math.cos(theta), math.sin(theta)
            goal = (x + cos * ahead - sin * left, y + sin * ahead + cos * left)
            world = self._worlds[number] if self._worlds else None
            scenes.append(Scene((x, y, theta), goal, world))
        return scenes


class RobotLink:
    """The link that a sensor of a batch is given: it has ground truth and time, but no wire."""

    lateness: float | None = None

    def __init__(self, view: View, robot: int) -> None:
        self._view = view
        self._robots = np.array([robot])

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of its world."""
        (x, y, theta), (forward, rate), contact = (
            array[0].tolist() for array in self._view.truths(self._robots)
        )
        return GroundTruth((x, y, theta), (forward, rate), contact)

    def now(self) -> float:
        """Simulated time since the reset [s]."""
        return float(self._view.now(self._robots)[0])

    def open(self) -> None:
        """Do nothing: there is no device."""

    def reset(self, scene: Scene) -> None:
        """Do nothing: the batch resets its robots."""

    def close(self) -> None:
        """Do nothing: there is no device."""

    def write(self, data: bytes) -> NoReturn:
        """Raise LinkError: robots of a batch have no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")

    def advance(self, period: float) -> NoReturn:
        """Raise LinkError: robots of a batch have no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")

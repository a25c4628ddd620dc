"""What an episode looked like, step by step, to draw it afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.errors import ConfigError
from acsar_gym.lidars.base import newest_scan
from acsar_gym.worlds import World
from acsar_gym.worlds.scene import point_in_world, to_world

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False, slots=True)
class Track:
    """Poses and scans of an episode at the reset and after every env step.

    In the frame of the world; on an open floor that of the odometry.
    """

    odometry: Floats
    """(N, 3): x, y [m], theta [rad]."""
    truth: Floats | None
    """(N, 3); None on hardware."""
    scans: Floats | None
    """(N, rays): ranges of the LiDAR [m]; None without one."""
    goal: tuple[float, float]
    goal_radius: float
    """What pictures show as the goal [m]."""
    period: float
    """Duration of an env step [s]."""
    robot: RobotConfig
    world: World | None = None


class TrackedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes the robot's pose and scan at the reset and at every step.

    Args:
        env: an env of this package, wrapped or not.

    Raises:
        ConfigError: it is one of another package.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        if not isinstance(env.unwrapped, RobotEnv):
            raise ConfigError(f"{env}: only environments of acsar_gym can be drawn")
        self._robot_env: RobotEnv = env.unwrapped
        self._rows: list[tuple[float, ...]] = []
        self._scans: list[NDArray[np.float32]] = []

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # read only, as Gymnasium's wrappers
        """The spec of the env, without this wrapper."""
        return self.env.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and its track."""
        told = self.env.reset(seed=seed, options=options)
        self._rows, self._scans = [], []
        self._note(told[1])
        return told

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and note where the robot is."""
        told = self.env.step(action)
        self._note(told[4])
        return told

    def _note(self, info: dict[str, Any]) -> None:
        names = ("odom_x", "odom_y", "odom_theta", "true_x", "true_y", "true_theta")
        self._rows.append(tuple(info[name] for name in names))
        scan = newest_scan(self._robot_env.sensors)
        if scan is not None:
            self._scans.append(scan.ranges.astype(np.float32))

    def track(self) -> Track:
        """Return the track of the newest episode."""
        env = self._robot_env
        assignment = env.episode.assignment
        start, rows = assignment.start, np.array(self._rows)
        placed = [
            np.array([to_world(start, pose) for pose in part.tolist()], np.float32)
            for part in (rows[:, :3], rows[:, 3:])
            if np.isfinite(part).all()
        ]
        return Track(
            odometry=placed[0],
            truth=placed[1] if len(placed) > 1 else None,
            scans=np.array(self._scans) if len(self._scans) == len(rows) else None,
            goal=point_in_world(start, assignment.goal),
            goal_radius=env.task.goal_tolerance,
            period=env.ticks_per_step * env.robot.config.period,
            robot=env.robot.config,
            world=assignment.world,
        )

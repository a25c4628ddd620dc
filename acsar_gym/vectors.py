"""The registered environments as batches: each class chooses the task of its id."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.tasks import Barn, ObstacleGoal, PathFollow, PointGoal
from acsar_gym.tasks.place import pool
from acsar_gym.vector import RobotVectorEnv
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.pool import Source


class PointGoalVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/PointGoal-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: RobotSource = None,
        *,
        goal_distance: tuple[float, float] = (0.5, 3.0),
        goal_tolerance: float = 0.15,
        **options: Any,
    ) -> None:
        super().__init__(
            lambda config: PointGoal.of(goal_distance, goal_tolerance, config),
            num_envs,
            robot,
            **options,
        )


class ObstacleGoalVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/ObstacleGoal-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: RobotSource = None,
        *,
        worlds: Source = "clutter:train",
        difficulty: Level = None,
        goal_tolerance: float = 0.3,
        **options: Any,
    ) -> None:
        super().__init__(
            lambda c: ObstacleGoal.of(pool(worlds, difficulty, c), goal_tolerance, c),
            num_envs,
            robot,
            **options,
        )


class BarnVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/Barn-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: RobotSource = None,
        *,
        worlds: Source = "barn:train",
        difficulty: Level = None,
        policy_rate: float = 10.0,
        **options: Any,
    ) -> None:
        super().__init__(
            lambda c: Barn.of(pool(worlds, difficulty, c), policy_rate, c),
            num_envs,
            robot,
            policy_rate=policy_rate,
            **options,
        )


class PathFollowVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/PathFollow-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: RobotSource = None,
        *,
        worlds: Source = "smooth_path:train",
        difficulty: Level = None,
        max_cross_track: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(
            lambda c: PathFollow.of(pool(worlds, difficulty, c), max_cross_track, c),
            num_envs,
            robot,
            **options,
        )

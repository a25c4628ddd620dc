"""`acsar_gym/Barn-v1`: the manual of the id, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import Barn
from acsar_gym.vector.env import RobotVectorEnv


class BarnEnv(RobotEnv):
    """BARN (Perille et al. 2020): 10 m through a field of cylinders, scored by the time it took.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((97 + rays,), float32)`, as in `acsar_gym/ObstacleGoal-v1`.

    ## Reward

    As in `acsar_gym/ObstacleGoal-v1`.
    `reward_threshold` 13.

    ## Start and end

    BARN's rules: start at (-2, 3) of the world heading along +y, goal 10 m ahead, success within
    1 m of it by odometry, a collision ends the episode, and so do BARN's 100 s, as truncation after
    1000 steps (at 10 Hz). `reset(options={"world": 1017})` chooses the world.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `max_episode_steps`, `render_mode`, `view`, `faults`,
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`, `difficulty`
      and `lidar` as in `acsar_gym/ObstacleGoal-v1`.
    - `worlds`: "barn:train", 400 worlds generated like the published ones, or "barn:test", the 300
      that `acsar-gym evaluate` tests in; or a folder of published worlds, `world_N.world` with
      `path_N.npy` beside them or in `path_files`. More as in `acsar_gym/ObstacleGoal-v1`.

    ## Info

    As in `acsar_gym/ObstacleGoal-v1`, and the score of the run, which is 0 until the goal is
    reached: success * OT / clip(AT, k * OT, 8 * OT), where AT is the time it took and OT the length
    of the world's path over a speed. `barn_score` has k = 2 (the challenge since 2024) and
    `barn_score_k4` k = 4 (2022), both with the challenge's 2 m/s; `barn_score_own` and
    `barn_score_own_k4` have the robot's own `max_linear` instead. They are NaN where a goal is
    given, for the world's path doesn't lead there.

    ## Version history

    - v1: reward and observation as in `acsar_gym/ObstacleGoal-v1`.
    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(Barn, link, robot, **options)


class BarnVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/Barn-v1`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(Barn, num_envs, robot, **options)

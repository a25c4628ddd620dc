"""`acsar_gym/PathFollow-v0`: the manual of the id, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import PathFollow
from acsar_gym.vector.env import RobotVectorEnv


class PathFollowEnv(RobotEnv):
    """Follow a path on an open floor, seeing nothing but odometry.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((18,), float32)`, from odometry alone:

    | index | observation | range |
    |---|---|---|
    | 0 | cross-track error (left of the path is positive) / `max_cross_track` | -2 to 2 |
    | 1, 2 | cosine and sine of the heading error | -1 to 1 |
    | 3 | length of the path that remains / 10 m | 0 to 2 |
    | 4 to 11 | the path 0.5, 1, 1.5 and 2 s on: x and y in the robot's frame / (2 s) | -2 to 2 |
    | 12 | linear velocity / `max_linear` | -2 to 2 |
    | 13 | angular velocity / `max_angular` | -2 to 2 |
    | 14, 15 | the last action | -1 to 1 |
    | 16 | `max_linear` / (1 m/s) | 0 to 2 |
    | 17 | `max_angular` / (4 rad/s) | 0 to 2 |

    Seconds are those at `max_linear`: 0.5 s are 0.25 m for the ACSAR robot.

    ## Reward

    0.1 times what was gained along the path / (`max_linear` * step), less 0.02 a step, 1 a metre
    beside the path, and 0.05 times the backward part of the action; +2 at the end, -2 out of
    bounds.
    `reward_threshold` 10 (`acsar-gym evaluate --policy path_follow --episodes 200`: 11.1).

    ## Start and end

    The robot stands at the path's beginning and looks along it. The episode terminates when
    odometry says that the robot is within 0.15 m of the path's end, having followed it (success),
    or farther than `max_cross_track` beside it; it is truncated after 400 steps.
    `reset(options={"path": [(x, y), ...]})` gives a path in the odometry frame, `{"world": 1017}`
    chooses one of the env's own.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `max_episode_steps`, `render_mode`, `view`, `faults`,
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`.
    - `worlds`: "smooth_path:train" or "waypoint_path:train", "smooth_path:test" and the like, as in
      `acsar_gym/ObstacleGoal-v1`; or a file, a folder or a list of worlds that have a path.
    - `difficulty` of generated paths, 0 to 1: how tight they turn; None or a range varies it.
    - `max_cross_track` [m].

    ## Info

    As in `acsar_gym/PointGoal-v0` but for `goal_distance`, and by odometry:
    `cross_track_error` [m], `heading_error` [rad], `path_progress` (0 to 1), and the score:
    `mean_cross_track_error` [m] and `mean_heading_error` [rad], means of the absolute errors over
    the steps so far. `world` is the generator's number of the path, -1 for a given one.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(PathFollow, link, robot, **options)


class PathFollowVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/PathFollow-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(PathFollow, num_envs, robot, **options)

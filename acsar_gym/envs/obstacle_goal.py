"""`acsar_gym/ObstacleGoal-v1`: the manual of the id, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.base import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import ObstacleGoal
from acsar_gym.vector.env import RobotVectorEnv


class ObstacleGoalEnv(RobotEnv):
    """Drive a four-wheel skid-steer robot to a point among obstacles that its LiDAR sees.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((10 + rays,), float32)`, with the 64 rays of the ACSAR robot (74,):

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / 10 m, by odometry | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame, by odometry | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |
    | 7 | time since the robot last came nearer to the goal / 10 s | 0 to 1 |
    | 8 | how much further the goal is than it was at the nearest [m] | 0 to 2 |
    | 9 | mean turn rate of the last seconds / `max_angular` (time constant 3 s) | -2 to 2 |
    | 10 on | range of each ray / `lidar.max_range`, counter-clockwise from the back | 0 to 1 |

    Rays are those of `robot.lidar` (rays, field_of_view, min_range, max_range, rate, noise,
    dropouts) at the robot's `lidar_x_offset` and `lidar_y_offset`: ray k points at
    -field_of_view / 2 + k * step from the robot's x axis. What isn't measured reads 1.

    ## Reward

    Twice the metres gained on the goal; less 0.01 a step, 0.05 times observation 7, 0.05 times the
    backward part of the action, and 0.15 (1 - c / 0.15 m) where the footprint's clearance c along
    the rays is less than 0.15 m; +5 at the goal, -15 for a collision.
    `reward_threshold` 12 (`acsar-gym evaluate --policy obstacle_goal --episodes 200`: 13.4).

    ## Start and end

    Every episode takes place in one of the env's numbered worlds. The robot stands at the world's
    start, which is the origin of the odometry frame. The episode terminates when odometry says that
    the robot is within `goal_tolerance` of the goal (success), or when a simulated robot touches an
    obstacle (collision; a real one can't tell). It is truncated after 400 steps.

    `reset(options={"world": 1017})` chooses the world by its number, or gives a World;
    `{"goal": (x, y)}` sets the goal in the odometry frame, which is what hardware needs: a real
    robot's surroundings aren't those of the world that was drawn.

    ## Arguments

    - `link`, `robot`, `goal_tolerance`, `policy_rate`, `render_mode`, `view`, `faults`,
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`.
    - `worlds`: "clutter:train" by default, the 400 worlds to train in; "clutter:test" are the 200
      that `acsar-gym evaluate` tests in. "clutter:50" means the first 50, "clutter:100-149" those
      with these numbers, "clutter" alone the training split; so with the other kinds ("open",
      "rooms", "barn"), and with those that `acsar_gym.worlds.register` adds. Or a file (.world, ROS
      map, .json, .yaml), a folder of them, a World, or a list of World.
    - `difficulty` of generated worlds, 0 to 1; None or a range (low, high) varies it.
    - `lidar`: None for the simulated one, model and device like "rplidar:///dev/ttyUSB1" on
      hardware, "module:Class", or a Lidar.

    ## Info

    As in `acsar_gym/PointGoal-v0`, and `world`, `scan_age` [s] and `scan_stale` (1 for a scan older
    than two periods of the LiDAR). `world` is the generator's number ("clutter 1017" is 1017), the
    place in a folder or list, from 0, or -1 for a World given to reset. A scan older than
    `lidar.timeout` stops the robot with LidarError.

    ## Version history

    - v1: the reward minds the footprint's clearance, and robots that stand still; observations 7
      to 9 are new, the rays follow them.
    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(ObstacleGoal, link, robot, **options)


class ObstacleGoalVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/ObstacleGoal-v1`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(ObstacleGoal, num_envs, robot, **options)

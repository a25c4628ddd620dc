"""`acsar_gym/ObstacleGoal-v1`: the manual of the id, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import ObstacleGoal
from acsar_gym.vector.env import RobotVectorEnv


class ObstacleGoalEnv(RobotEnv):
    """Drive a four-wheel skid-steer robot to a point among obstacles that its LiDAR sees.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((97 + rays,), float32)`, with the 64 rays of the ACSAR robot (161,). All but the rays are
    in units of the robot: the first 97 numbers are as many, and mean the same, for every robot. "R"
    is the radius of the footprint's circle, from the base's middle.

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / 10 m, by odometry | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame, by odometry | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |
    | 7 | what the way has become shorter in the last step / (`max_linear` * step) | -2 to 2 |
    | 8 | length of the way to the goal, log(1 + 4 length / R) / log(1 + 4 * 64) | 0 to 1 |
    | 9 to 14 | cosine, sine of the bearings of the way's points 2 R, 4 R, 8 R ahead | -1 to 1 |
    | 15 to 17 | largest cost of a metre, less 1, in straight lines to these points / 16 | 0 to 1 |
    | 18 | steps since the way was last shorter by R / 4 than ever before / 50 | 0 to 1 |
    | 19 | radius of the circle within the footprint / R | 0 to 1 |
    | 20 | `max_linear` / (10 R) | 0 to 1 |
    | 21 | `max_angular` / 4 rad/s | 0 to 1 |
    | 22 | stopping distance from `max_linear` / (4 R) | 0 to 1 |
    | 23 | angle in which `max_angular` is stopped / pi | 0 to 1 |
    | 24 | distance driven before what was sensed is acted on / R | 0 to 1 |
    | 25 | `lidar.max_range` / (32 R) | 0 to 1 |
    | 26 | 0.7 m/s^2 / (`max_linear` * `max_angular`): both at once slide below 1 | 0 to 1 |
    | 27 to 74 | clearances c in 48 directions, log(1 + 4 c / R) / log(1 + 4 * 16) | 0 to 1 |
    | 75 to 85 | free ways w along 11 arcs, log(1 + 4 w / R) / log(1 + 4 * 8) | 0 to 1 |
    | 86 to 96 | the same with 0.25 R of room on both sides | 0 to 1 |
    | 97 on | range of each ray / `lidar.max_range`, counter-clockwise from the back | 0 to 1 |

    Numbers 7 to 96 are those of the map, which remembers what the LiDAR has seen. The way is the
    cheapest one over it, where a metre costs more near an obstacle and what hasn't been seen is
    free. Directions go counter-clockwise from the back, 7.5 degrees each: 27 begins there, and 50
    and 51 are ahead. A clearance is the length from the footprint's edge to the obstacle, along a
    line from the base's middle; where the LiDAR doesn't look, what was seen before counts, up to
    8 R away, and what was never seen has a clearance of 0.5 R. A free way is what the
    footprint can drive along an arc before it touches something. The arcs' curvatures are -0.9,
    -0.55, -0.3, -0.15, -0.06, 0, 0.06, 0.15, 0.3, 0.55 and 0.9 / R, from right to left.
    Values beyond a range are clipped to it.

    Rays are those of `robot.lidar` (rays, field_of_view, min_range, max_range, rate, noise,
    dropouts) at the robot's `lidar_x_offset` and `lidar_y_offset`: ray k points at
    -field_of_view / 2 + k * step from the robot's x axis. What isn't measured reads 1.

    ## Reward

    0.1 times observation 7, so that the way counts and not the straight line; less 0.04 a step,
    0.1 times observation 18, 0.05 times the backward part of the action, and 0.15 (1 - a / b)
    where the least of observations 27 to 74, a, is below b, which stands for 0.5 R; less 0.1 for
    each m/s^2 of acceleration sideways (linear times angular velocity) over 0.7, up to 0.2, because
    odometry drifts where tyres slide; +5 at the goal, -15 for a collision.
    `reward_threshold` 10.

    ## Start and end

    Every episode takes place in one of the env's numbered worlds. The robot stands at the world's
    start, which is the origin of the odometry frame. The episode terminates when odometry says that
    the robot is within `goal_tolerance` of the goal (success), or when a simulated robot touches an
    obstacle (collision; a real one can't tell). It is truncated after 600 steps.

    `reset(options={"world": 1017})` chooses the world by its number, or gives a World;
    `{"goal": (x, y)}` sets the goal in the odometry frame, which is what hardware needs: a real
    robot's surroundings aren't those of the world that was drawn.

    ## Arguments

    - `link`, `robot`, `goal_tolerance`, `policy_rate`, `max_episode_steps`, `render_mode`, `view`,
      `faults`, `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`.
    - `worlds`: "clutter:train" by default, the 400 worlds to train in; "clutter:test" are the 200
      that `acsar-gym evaluate` tests in. "clutter:50" means the first 50, "clutter:100-149" those
      with these numbers, "clutter" alone the training split; so with the other kinds ("open",
      "rooms", "barn"), and with those that `acsar_gym.worlds.register` adds. Or a file (.world,
      .sdf, ROS map, .json, .yaml), a folder of them, a World, or a list of World; or a file with
      what it doesn't say, {"path": "hall.sdf", "start": (0, 0, 1.57), "goal": (4, 0)}.
    - `difficulty` of generated worlds, 0 to 1; None or a range (low, high) varies it.
    - `lidar`: None for the simulated one, model and device like "rplidar:///dev/ttyUSB1" on
      hardware, "module:Class", or a Lidar.

    ## Info

    As in `acsar_gym/PointGoal-v0`, and `world`, `scan_age` [s] and `scan_stale` (1 for a scan older
    than two periods of the LiDAR). `world` is the generator's number ("clutter 1017" is 1017), the
    place in a folder or list, from 0, or -1 for a World given to reset. A scan older than
    `lidar.timeout` stops the robot with LidarError.

    ## Version history

    - v1: a map that remembers comes before the rays; the reward is for the way over it and minds
      the footprint's clearance; an episode is truncated after 600 steps instead of 400.
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

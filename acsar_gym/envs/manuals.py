"""The registered environments: each id's manual, and its classes for one robot and for many.

`acsar_gym.RobotEnv` describes what all ids share: actions, arguments, info and versions.
"""

from __future__ import annotations

from typing import Any, ClassVar

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import Barn, Crowd, DynaBarn, ObstacleGoal, PathFollow, PointGoal, Task
from acsar_gym.vector.env import RobotVectorEnv


class RegisteredEnv(RobotEnv):
    """Base of the ids' classes for one robot."""

    task_class: ClassVar[type[Task]]

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(self.task_class, link, robot, **options)


class RegisteredVectorEnv(RobotVectorEnv):
    """Base of the ids' classes for many robots."""

    task_class: ClassVar[type[Task]]

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(self.task_class, num_envs, robot, **options)


class PointGoalEnv(RegisteredEnv):
    """Drive a four-wheel skid-steer robot to a point, seeing only its odometry.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    `Box((7,), float32)`, from odometry, in the odometry frame that starts at the robot:

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / largest goal distance | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |

    ## Reward

    | weight | default | term |
    |---|---|---|
    | `progress` | 2 | reward for each metre by which the robot comes closer to the goal |
    | `time` | 0.02 | cost of a step |
    | `backwards` | 0.05 | cost of the backward part of the action, because sensors look ahead |
    | `success` | 2 | reward at the goal |
    | `failure` | 2 | cost of leaving the bounds |

    `reward_threshold` 4.

    ## Start and end

    The robot is at the origin of the odometry frame. The goal lies 0.5 to 3 m away in any
    direction. `reset(options={"goal": (x, y)})` sets it. The episode terminates when odometry
    says that the robot is within `goal_tolerance` of the goal (success) or twice the largest goal
    distance away from the start. It is truncated after 200 steps.

    ## Arguments

    - `goal_distance`: Nearest and farthest goal [m].
    - `goal_tolerance`: Radius of the goal [m].
    - `distance_scale`: What observed distances are divided by [m]. None: the farthest goal's
      distance.
    """

    task_class = PointGoal


class PointGoalVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/PointGoal-v0`. See `RobotVectorEnv`."""

    task_class = PointGoal


class ObstacleGoalEnv(RegisteredEnv):
    """Drive a four-wheel skid-steer robot to a point among obstacles that its LiDAR sees.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    `Box((97 + rays,), float32)`, (161,) with the 64 rays of the ACSAR robot. Except for the rays,
    numbers are in units of the robot: the first 97 numbers have the same meaning for every robot.
    "R" is the radius of the footprint's circle, from the base's middle.

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / 10 m, by odometry | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame, by odometry | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |
    | 7 | by how much the last step shortened the way / (`max_linear` * step) | -2 to 2 |
    | 8 | length of the way to the goal, log(1 + 4 length / R) / log(1 + 4 * 64) | 0 to 1 |
    | 9 to 14 | cosine, sine of the bearings of the way's points 2 R, 4 R, 8 R ahead | -1 to 1 |
    | 15 to 17 | largest cost of a metre, less 1, in straight lines to these points / 16 | 0 to 1 |
    | 18 | steps since the way was last shorter by R / 4 than ever before / 50 | 0 to 1 |
    | 19 | radius of the circle within the footprint / R | 0 to 1 |
    | 20 | `max_linear` / (10 R) | 0 to 1 |
    | 21 | `max_angular` / 4 rad/s | 0 to 1 |
    | 22 | stopping distance from `max_linear` / (4 R) | 0 to 1 |
    | 23 | angle in which `max_angular` is stopped / pi | 0 to 1 |
    | 24 | distance driven between sensing and acting / R | 0 to 1 |
    | 25 | `lidar.max_range` / (32 R) | 0 to 1 |
    | 26 | 0.7 m/s^2 / (`max_linear` * `max_angular`): both at once slide below 1 | 0 to 1 |
    | 27 to 74 | clearances c in 48 directions, log(1 + 4 c / R) / log(1 + 4 * 16) | 0 to 1 |
    | 75 to 85 | free ways w along 11 arcs, log(1 + 4 w / R) / log(1 + 4 * 8) | 0 to 1 |
    | 86 to 96 | free ways with 0.25 R of room on both sides | 0 to 1 |
    | 97 on | range of each ray / `lidar.max_range`, counter-clockwise from the back | 0 to 1 |

    Numbers 7 to 96 are those of the map, which remembers what the LiDAR has seen. The way is the
    cheapest one over the map: a metre costs more near an obstacle, and unseen space counts as
    free. Directions go counter-clockwise from the back, 7.5 degrees each: 27 starts there, and 50
    and 51 are ahead. A clearance is the length from the footprint's edge to the obstacle, along a
    line from the base's middle. In directions that the LiDAR doesn't see, what was seen before
    counts, up to 8 R away. What was never seen has a clearance of 0.5 R. A free way is what the
    footprint can drive along an arc before it touches something. The arcs' curvatures are -0.9,
    -0.55, -0.3, -0.15, -0.06, 0, 0.06, 0.15, 0.3, 0.55 and 0.9 / R, from right to left.
    Values beyond a range are clipped to it.

    Rays are those of `robot.lidar` (rays, field_of_view, min_range, max_range, rate, noise,
    dropouts) at the robot's `lidar_x_offset` and `lidar_y_offset`: ray k points at
    -field_of_view / 2 + k * step from the robot's x axis. A ray without a measurement reads 1.

    ## Reward

    | weight | default | term |
    |---|---|---|
    | `progress` | 0.1 | reward times observation 7: the way counts, not the straight line |
    | `time` | 0.04 | cost of a step |
    | `near` | 0.15 | cost of touching something, 0 from a clearance of 0.5 R on |
    | `backwards` | 0.05 | cost of the backward part of the action |
    | `slide` | 0.1 | cost of each m/s^2 sideways above 0.7, up to 2: sliding makes odometry drift |
    | `stalled` | 0.1 | cost times observation 18 |
    | `success` | 5 | reward at the goal |
    | `collision` | 15 | cost of a collision |

    `near` counts 1 - a / b: a is the least of observations 27 to 74, and b stands for 0.5 R.
    Acceleration sideways is linear times angular velocity. `reward_threshold` 10.

    ## Start and end

    Every episode takes place in one of the env's numbered worlds. The robot is at the world's
    start, which is the origin of the odometry frame. The episode terminates when odometry says that
    the robot is within `goal_tolerance` of the goal (success), or when a simulated robot touches an
    obstacle (collision, which a real robot can't detect). It is truncated after 600 steps.

    `reset(options={"world": 1017})` chooses the world by its number, or gives a World.
    `{"goal": (x, y)}` sets the goal in the odometry frame, which hardware needs: a real robot isn't
    in the world that was drawn.

    ## Arguments

    - `goal_tolerance`: Radius of the goal [m].
    - `worlds`: "clutter:train" by default, the 400 worlds to train in. "clutter:test" are the 200
      that `acsar-gym evaluate` tests in.
    """

    task_class = ObstacleGoal


class ObstacleGoalVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/ObstacleGoal-v1`. See `RobotVectorEnv`."""

    task_class = ObstacleGoal


class BarnEnv(RegisteredEnv):
    """BARN (Perille et al. 2020): 10 m through a field of cylinders, scored by the time it took.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    `Box((97 + rays,), float32)`, as in `acsar_gym/ObstacleGoal-v1`.

    ## Reward

    As in `acsar_gym/ObstacleGoal-v1`, with the same weights: for progress along the way over the
    map, 5 at the goal, -15 for a collision.

    `reward_threshold` 13.

    ## Start and end

    BARN's rules: start at (-2, 3) of the world heading along +y, goal 10 m ahead, success within
    1 m of it by odometry. A collision ends the episode, and it is truncated after BARN's 100 s,
    1000 steps at 10 Hz. `reset(options={"world": 1017})` chooses the world.

    ## Arguments

    - `worlds`: "barn:train", 400 worlds generated like the published ones, or "barn:test", the 300
      that `acsar-gym evaluate` tests in. Or a folder of published worlds, `world_N.world` with
      `path_N.npy` next to them or in `path_files`.

    ## Info

    The score of the run, which is 0 until the goal is reached: success * OT / clip(AT, k * OT,
    8 * OT). AT is the time it took, and OT the length of the world's path divided by a speed.
    `barn_score` has k = 2 (the challenge since 2024) and `barn_score_k4` k = 4 (2022), both with
    the challenge's 2 m/s. `barn_score_own` and `barn_score_own_k4` have the robot's own
    `max_linear` instead. They are NaN if a goal is given, because the world's path doesn't lead
    there.
    """

    task_class = Barn


class BarnVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/Barn-v1`. See `RobotVectorEnv`."""

    task_class = Barn


class CrowdEnv(RegisteredEnv):
    """Cross a hall that people walk through, whom the robot sees with a LiDAR.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    `Box((185 + rays,), float32)`, (249,) with the 64 rays of the ACSAR robot. Numbers 0 to 96 are
    those of `acsar_gym/ObstacleGoal-v1`, and the rays come last, as there. Between them are six
    tracks of objects that the LiDAR sees completely, eight numbers each. Those come first that the
    robot could meet first if it drove there at its top speed:

    | index | observation of the first track (the next tracks follow) | range |
    |---|---|---|
    | 97 | number of scans that have shown it / 10 (without a track all eight are 0) | 0 to 1 |
    | 98, 99 | vector from the base to its middle, ahead and to the left | -1 to 1 |
    | 100, 101 | its velocity over the floor, ahead and to the left / (4 `max_linear`) | -1 to 1 |
    | 102 | its radius / (4 R) | 0 to 1 |
    | 103 | 1: it surely moves, 0.5: it has moved and is at rest now, 0: otherwise | 0 to 1 |
    | 104 | standard deviation of its speed [m/s] | 0 to 1 |

    The length of the vector at 98 is log(1 + 4 d / R) / log(1 + 4 * 16), d being the distance from
    the base's middle. Hidden people have no track, and the map forgets what surely moves.

    Then come 20 courses that the robot could take (`sensors/map/courses.py`): at its top speed on
    the 11 arcs, at half of it on five, at rest, and three backwards. If it did, and those who move
    kept their velocities for 2.4 s:

    | index | observation | range |
    |---|---|---|
    | 145 to 164 | when the robot would meet a person / 2.4 s (1 for never) | 0 to 1 |
    | 165 to 184 | least gap g to a person: log(1 + 4 g / R) / log(17) | 0 to 1 |

    ## Reward

    As in `acsar_gym/ObstacleGoal-v1`, with the same weights (5 at the goal, -15 for a collision)
    and another one:

    | weight | default | term |
    |---|---|---|
    | `crowding` | 0.1 | cost of a person who touches the robot's circle, 0 from 0.45 m on |

    Only people whom the robot has seen moving count (observations 97 to 144).

    ## Start and end

    Every episode takes place in one of the env's numbered worlds: a corridor, a crossing, rooms
    with doors or an open floor, in which people walk. Where they are at its start is drawn again
    for each episode. The robot is at the world's start, which is the origin of the odometry frame.
    The episode terminates when odometry says that the robot is within 0.5 m of the goal (success),
    or when a simulated robot and an obstacle or a person touch, whoever ran into whom
    (`person_contact`). It is truncated after 800 steps.
    `reset(options={"world": 1017})` chooses the world, `{"goal": (x, y)}` sets the goal, as in
    `acsar_gym/ObstacleGoal-v1`.

    ## Arguments

    - `worlds`: "crowd:train" by default, the 400 worlds to train in, in which people ignore each
      other and the robot. "crowd:test" are the 200 that `acsar-gym evaluate` tests in. In
      "crowd_reacting" some people keep a distance from others, and most of these see the robot.
    """

    task_class = Crowd


class CrowdVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/Crowd-v0`. See `RobotVectorEnv`."""

    task_class = Crowd


class DynaBarnEnv(RegisteredEnv):
    """DynaBARN (Nair et al. 2022): across a floor of obstacles that move on polynomial curves.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    As in `acsar_gym/Crowd-v0`.

    ## Reward

    As in `acsar_gym/Crowd-v0`, with the same weights except for that of a collision:

    | weight | default | term |
    |---|---|---|
    | `collision` | 30 | cost of a collision |

    ## Start and end

    Start and goal of the world, success within 1 m of the goal by odometry. A contact ends the
    episode, and it is truncated after 100 s, 1000 steps at 10 Hz. The obstacles react to nothing.
    `reset(options={"world": 1017})` chooses the world, `{"goal": (x, y)}` sets the goal.

    ## Arguments

    - `worlds`: "dynabarn:train", 400 worlds generated like the published ones, or "dynabarn:test",
      the 200 that `acsar-gym evaluate` tests in.
    """

    task_class = DynaBarn


class DynaBarnVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/DynaBarn-v0`. See `RobotVectorEnv`."""

    task_class = DynaBarn


class PathFollowEnv(RegisteredEnv):
    """Follow a path on an open floor, seeing only odometry.

    `help(acsar_gym.RobotEnv)` describes actions, arguments and info.

    ## Observation space

    `Box((18,), float32)`, from odometry:

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

    | weight | default | term |
    |---|---|---|
    | `progress` | 0.1 | reward times the progress along the path / (`max_linear` * step) |
    | `time` | 0.02 | cost of a step |
    | `cross_track` | 1 | cost of each metre of distance from the path |
    | `backwards` | 0.05 | cost of the backward part of the action |
    | `success` | 2 | reward at the end of the path |
    | `failure` | 2 | cost of leaving the bounds |

    `reward_threshold` 10.

    ## Start and end

    The robot is at the path's beginning and heads along it. The episode terminates when odometry
    says that the robot is within 0.15 m of the path's end, having followed it (success), or farther
    than `max_cross_track` from the path. It is truncated after 400 steps.
    `reset(options={"path": [(x, y), ...]})` gives a path in the odometry frame, `{"world": 1017}`
    chooses one of the env's paths.

    ## Arguments

    - `max_cross_track`: Farthest distance from the path [m].
    - `worlds`: "smooth_path:train" by default, or "waypoint_path:train", "smooth_path:test" and so
      on. Or a file, a folder or a list of worlds that have a path. `difficulty` is how tight
      generated paths turn.

    ## Info

    No `goal_distance`, but by odometry `cross_track_error` [m], `heading_error` [rad],
    `path_progress` (0 to 1), and the score: `mean_cross_track_error` [m] and `mean_heading_error`
    [rad], means of the absolute errors over the steps so far. `world` is the generator's number of
    the path, -1 for a given path.
    """

    task_class = PathFollow


class PathFollowVectorEnv(RegisteredVectorEnv):
    """Many robots of `acsar_gym/PathFollow-v0`. See `RobotVectorEnv`."""

    task_class = PathFollow

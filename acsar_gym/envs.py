"""The registered environments: each class is its id's manual, and chooses the task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.env import RobotEnv
from acsar_gym.lidar import Lidar
from acsar_gym.links import Link
from acsar_gym.links.faults import Faults
from acsar_gym.tasks import Barn, ObstacleGoal, PathFollow, PointGoal
from acsar_gym.tasks.place import pool
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.pool import Source


class PointGoalEnv(RobotEnv):
    """Drive a four-wheel skid-steer robot to a point, seeing nothing but its odometry.

    ## Action space

    `Box(-1, 1, (2,), float32)`, held for one step (100 ms by default):

    | index | action | full scale |
    |---|---|---|
    | 0 | linear velocity, forward positive | `max_linear` of the robot, 0.5 m/s |
    | 1 | angular velocity, counter-clockwise positive | `max_angular` of the robot, 1.5 rad/s |

    Finite values outside are clipped; NaN, infinity or a wrong shape raise CommandError after the
    wheels have been commanded to stop.

    ## Observation space

    `Box((7,), float32)`, from odometry alone, in the odometry frame that starts at the robot:

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / largest goal distance | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |

    ## Reward

    Twice the metres gained on the goal, less 0.02 a step and 0.05 times the backward part of the
    action (sensors look ahead); +2 at the goal, -2 out of bounds.
    `reward_threshold` 4: of every id it's about nine tenths of the mean `episode_return` of the
    policy that comes along (4.5: `acsar-gym evaluate --policy point_goal --episodes 200`).

    ## Start and end

    The robot stands at the origin of the odometry frame. The goal lies 0.5 to 3 m away in any
    direction; `reset(options={"goal": (x, y)})` sets it. The episode terminates when odometry says
    that the robot is within `goal_tolerance` of the goal (success) or twice the largest goal
    distance away from the start; it is truncated after 200 steps. On hardware, reset stops the
    robot, waits for standstill and sets the odometry to zero.

    ## Arguments

    - `link`: "bullet", "planar", a serial device such as "/dev/ttyUSB0", "socket://host:port",
      "replay:FILE", or a Link.
    - `robot`: a RobotConfig, its fields in a mapping (as in the env's spec), a preset's name, or a
      .yaml or .urdf file; None is the ACSAR robot.
    - `goal_distance`: nearest and farthest goal [m]. `goal_tolerance` [m].
    - `policy_rate`: steps per second [Hz]; the robot's control rate must be a whole multiple.
    - `render_mode`: "rgb_array", or "human" for a live window, in real time; without a display it
      draws off-screen, with a warning.
    - `view`: "top", drawn from above for every link, or "camera", PyBullet's behind the robot.
    - `faults`: what goes wrong on the wire and the board, such as {"dropped_lines": 0.1,
      "unplug_rate": 0.01}; see `acsar_gym.links.faults.Faults`. Drawn from the env's generator.
    - `on_fault`: "truncate" ends an episode in which the link or the board fails, with a number in
      info's `fault` (0 none, 1 silent, 2 garbled, 3 link lost, 4 LiDAR, 5 other; told at every step
      on hardware and where there are `faults`) and the whole message in `fault_reason`. The next
      reset opens the link again. "raise" raises the LinkError.

    ## Info

    The same floats at every step: `goal_distance` [m] and `is_success` by odometry, `odom_x`,
    `odom_y`, `odom_theta`, `feedback_age` [s]; `sent_linear` [m/s] and `sent_angular` [rad/s], the
    twist that was really sent in the last tick, and `sent_reason`, why it isn't the one asked for
    (0 it is, 1 limits, 2 geofence, 3 stale feedback, 4 emergency stop); and what only a simulator
    knows: `true_x`, `true_y`, `true_theta`, `true_goal_distance`, `true_contact` (whether the robot
    has touched something), and `odometry_error` [m], the distance between odometry and truth. Those
    are NaN on hardware. Everything is in the odometry frame.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        link: str | Link = "bullet",
        robot: RobotSource = None,
        *,
        goal_distance: tuple[float, float] = (0.5, 3.0),
        goal_tolerance: float = 0.15,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
        view: str = "top",
        faults: Mapping[str, Any] | Faults | None = None,
        on_fault: str = "truncate",
    ) -> None:
        super().__init__(
            lambda config: PointGoal.of(goal_distance, goal_tolerance, config),
            link,
            robot,
            policy_rate=policy_rate,
            render_mode=render_mode,
            view=view,
            faults=faults,
            on_fault=on_fault,
        )


class ObstacleGoalEnv(RobotEnv):
    """Drive a four-wheel skid-steer robot to a point among obstacles that its LiDAR sees.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((7 + rays,), float32)`, with the 64 rays of the ACSAR robot (71,):

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / 10 m, by odometry | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame, by odometry | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |
    | 7 on | range of each ray / `lidar.max_range`, counter-clockwise from the back | 0 to 1 |

    Rays are those of `robot.lidar` (rays, field_of_view, min_range, max_range, rate, noise,
    dropouts) at the robot's `lidar_x_offset` and `lidar_y_offset`: ray k points at
    -field_of_view / 2 + k * step from the robot's x axis. What isn't measured reads 1.

    ## Reward

    Twice the metres gained on the goal, less 0.02 a step and 0.05 times the backward part of the
    action; +5 at the goal, -5 for a collision.
    `reward_threshold` 10 (`acsar-gym evaluate --policy obstacle_goal --episodes 200`: 11.4).

    ## Start and end

    Every episode takes place in one of the env's numbered worlds. The robot stands at the world's
    start, which is the origin of the odometry frame. The episode terminates when odometry says that
    the robot is within `goal_tolerance` of the goal (success), or when a simulated robot touches an
    obstacle (collision; a real one can't tell). It is truncated after 400 steps.

    `reset(options={"world": 1017})` chooses the world by its number, or gives a World;
    `{"goal": (x, y)}` sets the goal in the odometry frame, which is what hardware needs: a real
    robot's surroundings aren't those of the world that was drawn.

    ## Arguments

    - `link`, `robot`, `goal_tolerance`, `policy_rate`, `render_mode`, `view`, `faults`, `on_fault`
      as in `acsar_gym/PointGoal-v0`.
    - `worlds`: "clutter:train" by default, the 400 worlds to train in; "clutter:test" are the 200
      that `acsar-gym evaluate` tests in. "clutter:50" means the first 50, "clutter:100-149" those
      with these numbers, "clutter" alone the training split; so with the other kinds ("open",
      "rooms", "barn"). Or a file (.world, ROS map, .json, .yaml), a folder of them, a World, or a
      list of World.
    - `difficulty` of generated worlds, 0 to 1; None or a range (low, high) varies it.
    - `lidar`: None for the simulated one, "rplidar:///dev/ttyUSB1" on hardware, or a Lidar.

    ## Info

    As in `acsar_gym/PointGoal-v0`, and `world`, `scan_age` [s] and `scan_stale` (1 for a scan older
    than two periods of the LiDAR). `world` is the generator's number ("clutter 1017" is 1017), the
    place in a folder or list, from 0, or -1 for a World given to reset. A scan older than
    `lidar.timeout` stops the robot with LidarError.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        link: str | Link = "bullet",
        robot: RobotSource = None,
        *,
        worlds: Source = "clutter:train",
        difficulty: Level = None,
        goal_tolerance: float = 0.3,
        lidar: str | Lidar | None = None,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
        view: str = "top",
        faults: Mapping[str, Any] | Faults | None = None,
        on_fault: str = "truncate",
    ) -> None:
        super().__init__(
            lambda c: ObstacleGoal.of(pool(worlds, difficulty, c), goal_tolerance, c),
            link,
            robot,
            lidar=lidar,
            policy_rate=policy_rate,
            render_mode=render_mode,
            view=view,
            faults=faults,
            on_fault=on_fault,
        )


class BarnEnv(RobotEnv):
    """BARN (Perille et al. 2020): 10 m through a field of cylinders, scored by the time it took.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((7 + rays,), float32)`, as in `acsar_gym/ObstacleGoal-v0`.

    ## Reward

    As in `acsar_gym/ObstacleGoal-v0`.
    `reward_threshold` 14 (`acsar-gym evaluate --policy barn --episodes 200`: 16.4).

    ## Start and end

    BARN's rules: start at (-2, 3) of the world heading along +y, goal 10 m ahead, success within
    1 m of it by odometry, a collision ends the episode, and so do BARN's 100 s, as truncation after
    1000 steps (at 10 Hz). `reset(options={"world": 1017})` chooses the world.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `render_mode`, `view`, `faults`, `on_fault` as in
      `acsar_gym/PointGoal-v0`, `difficulty` and `lidar` as in `acsar_gym/ObstacleGoal-v0`.
    - `worlds`: "barn:train", 400 worlds generated like the published ones, or "barn:test", the 300
      that `acsar-gym evaluate` tests in; or a folder of published worlds, `world_N.world` with
      `path_N.npy` beside them or in `path_files`. More as in `acsar_gym/ObstacleGoal-v0`.

    ## Info

    As in `acsar_gym/ObstacleGoal-v0`, and the score of the run, which is 0 until the goal is
    reached: success * OT / clip(AT, k * OT, 8 * OT), where AT is the time it took and OT the length
    of the world's path over a speed. `barn_score` has k = 2 (the challenge since 2024) and
    `barn_score_k4` k = 4 (2022), both with the challenge's 2 m/s; `barn_score_own` and
    `barn_score_own_k4` have the robot's own `max_linear` instead. They are NaN where a goal is
    given, for the world's path doesn't lead there.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        link: str | Link = "bullet",
        robot: RobotSource = None,
        *,
        worlds: Source = "barn:train",
        difficulty: Level = None,
        lidar: str | Lidar | None = None,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
        view: str = "top",
        faults: Mapping[str, Any] | Faults | None = None,
        on_fault: str = "truncate",
    ) -> None:
        super().__init__(
            lambda c: Barn.of(pool(worlds, difficulty, c), policy_rate, c),
            link,
            robot,
            lidar=lidar,
            policy_rate=policy_rate,
            render_mode=render_mode,
            view=view,
            faults=faults,
            on_fault=on_fault,
        )


class PathFollowEnv(RobotEnv):
    """Follow a path on an open floor, seeing nothing but odometry.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((16,), float32)`, from odometry alone:

    | index | observation | range |
    |---|---|---|
    | 0 | cross-track error (left of the path is positive) / `max_cross_track` | -2 to 2 |
    | 1, 2 | cosine and sine of the heading error | -1 to 1 |
    | 3 | length of the path that remains / 10 m | 0 to 2 |
    | 4 to 11 | the path 0.25, 0.5, 0.75 and 1 m on: x and y in the robot's frame [m] | -2 to 2 |
    | 12 | linear velocity / `max_linear` | -2 to 2 |
    | 13 | angular velocity / `max_angular` | -2 to 2 |
    | 14, 15 | the last action | -1 to 1 |

    ## Reward

    Twice the metres gained along the path, less 0.02 a step, 0.5 a metre beside the path, and 0.05
    times the backward part of the action; +2 at the end, -2 out of bounds.
    `reward_threshold` 10 (`acsar-gym evaluate --policy path_follow --episodes 200`: 11.1).

    ## Start and end

    The robot stands at the path's beginning and looks along it. The episode terminates when
    odometry says that the robot is within 0.15 m of the path's end, having followed it (success),
    or farther than `max_cross_track` beside it; it is truncated after 400 steps.
    `reset(options={"path": [(x, y), ...]})` gives a path in the odometry frame, `{"world": 1017}`
    chooses one of the env's own.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `render_mode`, `view`, `faults`, `on_fault` as in
      `acsar_gym/PointGoal-v0`.
    - `worlds`: "smooth_path:train" or "waypoint_path:train", "smooth_path:test" and the like, as in
      `acsar_gym/ObstacleGoal-v0`; or a file, a folder or a list of worlds that have a path.
    - `difficulty` of generated paths, 0 to 1: how tight they turn; None or a range varies it.
    - `max_cross_track` [m].

    ## Info

    As in `acsar_gym/PointGoal-v0` but for the goal's distances, and by odometry:
    `cross_track_error` [m], `heading_error` [rad], `path_progress` (0 to 1), and the score:
    `mean_cross_track_error` [m] and `mean_heading_error` [rad], means of the absolute errors over
    the steps so far. `world` is the generator's number of the path, -1 for a given one.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        link: str | Link = "bullet",
        robot: RobotSource = None,
        *,
        worlds: Source = "smooth_path:train",
        difficulty: Level = None,
        max_cross_track: float = 0.5,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
        view: str = "top",
        faults: Mapping[str, Any] | Faults | None = None,
        on_fault: str = "truncate",
    ) -> None:
        super().__init__(
            lambda c: PathFollow.of(pool(worlds, difficulty, c), max_cross_track, c),
            link,
            robot,
            policy_rate=policy_rate,
            render_mode=render_mode,
            view=view,
            faults=faults,
            on_fault=on_fault,
        )

"""The registered environments: each id's manual, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import Barn, Crowd, DynaBarn, ObstacleGoal, PathFollow, PointGoal
from acsar_gym.vector.env import RobotVectorEnv


class PointGoalEnv(RobotEnv):
    """Drive a four-wheel skid-steer robot to a point, seeing nothing but its odometry.

    ## Action space

    `Box(-1, 1, (2,), float32)`, held for one step (100 ms by default):

    | index | action | full scale |
    |---|---|---|
    | 0 | linear velocity, forward positive | `max_linear` of the robot, 0.5 m/s |
    | 1 | angular velocity, counter-clockwise positive | `max_angular` of the robot, 1.5 rad/s |

    Finite values outside are clipped; NaN, infinity, a wrong shape or what isn't numbers (such as a
    tensor that requires grad) raise CommandError after the wheels have been commanded to stop.

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
    `reward_threshold` 4: of every id that a policy comes along for, but those among people, it's
    about nine tenths of that policy's mean `episode_return` (4.5: `acsar-gym evaluate --policy
    point_goal --episodes 200`).

    ## Start and end

    The robot stands at the origin of the odometry frame. The goal lies 0.5 to 3 m away in any
    direction; `reset(options={"goal": (x, y)})` sets it. The episode terminates when odometry says
    that the robot is within `goal_tolerance` of the goal (success) or twice the largest goal
    distance away from the start; it is truncated after 200 steps. The step that ends it commands
    the wheels to stop, and a step after it is a ConfigError. On hardware, reset stops the robot,
    waits for standstill and sets the odometry to zero.

    ## Arguments

    - `link`: "bullet", "planar", "mujoco", a serial device such as "/dev/ttyUSB0",
      "socket://host:port", "replay:FILE", or a Link.
    - `robot`: a RobotConfig, its fields in a mapping (as in the env's spec), a preset's name, or a
      .yaml or .urdf file; None is the ACSAR robot.
    - `goal_distance`: nearest and farthest goal [m]. `goal_tolerance` [m]. `distance_scale`: what
      observed distances are divided by [m]; None: the farthest goal's distance.
    - `max_episode_steps`: time limit [steps]; None or -1 is none. `gymnasium.make` passes it to its
      TimeLimit wrapper, which the env finds.
    - `policy_rate`: steps per second [Hz]; the robot's control rate must be a whole multiple.
    - `render_mode`: "rgb_array", or "human" for a live window, in real time; without a display it
      draws off-screen, with a warning.
    - `view`: "top", drawn from above for every link, or "camera", the simulator's behind the robot.
    - `faults`: lines between driver and board that are lost or late, such as {"dropped_lines": 0.1,
      "late_lines": 0.05}; see `acsar_gym.links.faults.Faults`. Drawn from the env's generator.
    - `sensors`: more sensors, such as [ThreeRays] or ["mine.rays:ThreeRays"], subclasses of
      `acsar_gym.Sensor`; their numbers follow in the observation.
    - `randomization`: what a simulated robot draws anew for every episode, such as {"friction":
      (0.7, 1.2), "latency": (0.0, 0.02)}; see `acsar_gym.physics.Randomization`. True: what
      `acsar-gym train` randomizes.
    - `on_fault`: "truncate" ends an episode in which the link or the board fails, with a number in
      info's `fault` (0 none, 1 silent, 2 garbled, 3 link lost, 4 LiDAR, 5 other, 6 a wheel that
      contradicts its commands; told at every step on hardware and where there are `faults`) and
      the whole message in `fault_reason`. The next reset opens the link again. "raise" raises the
      LinkError.
    - `record`: file to which the whole drive is recorded (MCAP: topics of ROS 2, the raw wire, and
      what the policy saw and did); `link="replay:FILE"` plays it back. `close()` ends the file.

    ## Info

    The same floats at every step: `goal_distance` [m] and `is_success` by odometry, `odom_x`,
    `odom_y`, `odom_theta`, `feedback_age` [s]; `sent_linear` [m/s] and `sent_angular` [rad/s], the
    twist that was really sent in the last tick, and `sent_reason`, why it isn't the one asked for
    (0 it is, 1 limits, 2 geofence, 3 stale feedback, 4 emergency stop); and what only a simulator
    knows: `true_x`, `true_y`, `true_theta`, `true_goal_distance`, `true_contact` (whether the robot
    has touched something), and `odometry_error` [m], the distance between odometry and truth. Those
    are NaN on hardware. Everything is in the odometry frame. `drawn_` and the name of a randomized
    parameter tell what the episode has drawn, as applied: `drawn_motor_gain` and `drawn_motor_lag`
    are arrays of four, in the order of the wheels.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(PointGoal, link, robot, **options)


class PointGoalVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/PointGoal-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(PointGoal, num_envs, robot, **options)


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
      what it doesn't say, {"path": "hall.sdf", "start": (0, 0, 1.57), "goal": (4, 0)}. A list
      such as ["clutter:train", "barn:train"] has the worlds of several sets: `info` has no number
      then, and `options={"world": "clutter 1017"}` chooses a world by its name.
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
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`, `difficulty`,
      `lidar` as in `acsar_gym/ObstacleGoal-v1`.
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


class CrowdEnv(RobotEnv):
    """Cross a hall that people walk through, who are seen with a LiDAR.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    `Box((185 + rays,), float32)`, with the 64 rays of the ACSAR robot (249,). Numbers 0 to 96 are
    those of `acsar_gym/ObstacleGoal-v1`, and the rays come last, as there. Between them stand six
    tracks of what the LiDAR shows whole, eight numbers each, those first that the robot could meet
    first if it drove there at its top speed:

    | index | observation of the first one, and 8 on for each next one | range |
    |---|---|---|
    | 97 | scans that have shown it / 10; 0 where there is none, and so are the others | 0 to 1 |
    | 98, 99 | where it is from the base: a vector to its middle, ahead and to the left | -1 to 1 |
    | 100, 101 | its velocity over the floor, ahead and to the left / (4 `max_linear`) | -1 to 1 |
    | 102 | its radius / (4 R) | 0 to 1 |
    | 103 | 1 where it surely moves, 0.5 where it has moved and stands now, else 0 | 0 to 1 |
    | 104 | standard deviation of its speed [m/s] | 0 to 1 |

    The length of the vector at 98 is log(1 + 4 d / R) / log(1 + 4 * 16), d being the distance from
    the base's middle. Who is hidden isn't told, and the map forgets whoever surely moves.

    Then come 20 courses that the robot could take (`sensors/map/courses.py`): at its top speed on
    the 11 arcs, at half of it on five, standing, and three backwards. If it did, and those who move
    kept their velocities for 2.4 s:

    | index | observation | range |
    |---|---|---|
    | 145 to 164 | when it would meet somebody, in parts of the 2.4 s; 1 for nobody | 0 to 1 |
    | 165 to 184 | how near it would come to anybody: for g, log(1 + 4 g / R) / log(17) | 0 to 1 |

    ## Reward

    As in `acsar_gym/ObstacleGoal-v1`, and less 0.1 c, where c says how deep the robot is in the
    personal space of one that it has seen moving: 0 where all their hulls are 0.45 m or more from
    the circle around the robot, 1 where one touches it, by observations 97 to 144.

    ## Start and end

    Every episode takes place in one of the env's numbered worlds: a corridor, a crossing, rooms
    with doors or an open floor, in which people walk. Where they are at its begin is drawn anew for
    each episode. The robot stands at the world's start, which is the origin of the odometry frame.
    The episode terminates when odometry says that the robot is within 0.5 m of the goal (success),
    or when a simulated robot and an obstacle or a person touch, whoever ran into whom
    (`person_contact`). It is truncated after 800 steps.
    `reset(options={"world": 1017})` chooses the world, `{"goal": (x, y)}` sets the goal, as in
    `acsar_gym/ObstacleGoal-v1`.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `max_episode_steps`, `render_mode`, `view`, `faults`,
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`, `difficulty`,
      `lidar` as in `acsar_gym/ObstacleGoal-v1`.
    - `worlds`: "crowd:train" by default, the 400 worlds to train in, where people walk as if nobody
      else were there; "crowd:test" are the 200 that `acsar-gym evaluate` tests in. In
      "crowd_reacting" some people keep a distance from others, and most of these see the robot.
      More as in `acsar_gym/ObstacleGoal-v1`.

    ## Info

    As in `acsar_gym/ObstacleGoal-v1`, and what only a simulator knows of those who move, NaN on
    hardware: `closest_person` [m], from the robot's hull to the nearest one's now, 0 to 100;
    `time_to_collision` [s], until the circle around the robot would touch somebody if all kept
    their velocities, 0 to 10; `intrusions`, how often the robot has come within 0.45 m of somebody
    so far; and `person_contact`: 0 none, 1 the robot ran into somebody, 2 somebody ran into the
    robot. Every env whose worlds move has these.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(Crowd, link, robot, **options)


class CrowdVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/Crowd-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(Crowd, num_envs, robot, **options)


class DynaBarnEnv(RobotEnv):
    """DynaBARN (Nair et al. 2022): across a floor of obstacles that move on polynomial curves.

    ## Action space

    `Box(-1, 1, (2,), float32)`: linear and angular velocity, as in `acsar_gym/PointGoal-v0`.

    ## Observation space

    As in `acsar_gym/Crowd-v0`.

    ## Reward

    As in `acsar_gym/Crowd-v0`, but -30 for a collision.

    ## Start and end

    Start and goal of the world, success within 1 m of the goal by odometry; a contact ends the
    episode, and so do 100 s, as truncation after 1000 steps (at 10 Hz). The obstacles mind nobody.
    `reset(options={"world": 1017})` chooses the world, `{"goal": (x, y)}` sets the goal.

    ## Arguments

    - `link`, `robot`, `policy_rate`, `max_episode_steps`, `render_mode`, `view`, `faults`,
      `sensors`, `randomization`, `on_fault`, `record` as in `acsar_gym/PointGoal-v0`, `difficulty`,
      `lidar` as in `acsar_gym/ObstacleGoal-v1`.
    - `worlds`: "dynabarn:train", 400 worlds generated like the published ones, or "dynabarn:test",
      the 200 that `acsar-gym evaluate` tests in. More as in `acsar_gym/ObstacleGoal-v1`.

    ## Info

    As in `acsar_gym/Crowd-v0`.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self, link: str | Link = "bullet", robot: RobotSource = None, **options: Any
    ) -> None:
        super().__init__(DynaBarn, link, robot, **options)


class DynaBarnVectorEnv(RobotVectorEnv):
    """Many robots of `acsar_gym/DynaBarn-v0`; see `RobotVectorEnv` for the other arguments."""

    def __init__(self, num_envs: int = 1, robot: FleetSource = None, **options: Any) -> None:
        super().__init__(DynaBarn, num_envs, robot, **options)


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

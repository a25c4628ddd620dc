"""`acsar_gym/PointGoal-v0`: the manual of the id, and its classes for one robot and for many."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotSource
from acsar_gym.config.fleet import FleetSource
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.links import Link
from acsar_gym.tasks import PointGoal
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
    `reward_threshold` 4: of every id it's about nine tenths of the mean `episode_return` of the
    policy that comes along (4.5: `acsar-gym evaluate --policy point_goal --episodes 200`).

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
    - `faults`: what goes wrong on the wire and the board, such as {"dropped_lines": 0.1,
      "unplug_rate": 0.01}; see `acsar_gym.links.faults.Faults`. Drawn from the env's generator.
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

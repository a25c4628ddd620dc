"""The Gymnasium environment: one class for all tasks, in simulation and on hardware."""

from __future__ import annotations

import contextlib
import copy
import math
import sys
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Literal, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, RobotSource, whole_ratio
from acsar_gym.envs.time_limit import find_limits, is_last_step
from acsar_gym.errors import AcsarError, ConfigError, LinkError, check_extra, show_value
from acsar_gym.links import Link, open_link
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.physics import body
from acsar_gym.physics.bodies import BODIES, LINKS_WITH_CAMERA, BodyBackend
from acsar_gym.physics.body import Image
from acsar_gym.physics.randomization import Randomizer
from acsar_gym.recording import Recorder
from acsar_gym.render.renderer import Screen
from acsar_gym.robot import DriveObserver, Robot, StepResult
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.sensors.lidar import footprint_edges, newest_scan
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.tasks import Observation, Outcome, State, Task
from acsar_gym.tasks.actions import read_actions
from acsar_gym.tasks.episode import Assignment, ObservationCheck, RunningEpisode, Spawn
from acsar_gym.tasks.factory import make_task, task_name
from acsar_gym.tasks.options import SharedOptions, read_step_limit
from acsar_gym.tasks.spec import PlainSpec, task_spaces
from acsar_gym.tasks.state import (
    NO_PATH,
    NO_RANGES,
    CrowdInfo,
    StepInfo,
    Twist,
)
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.crowd import FARTHEST_COLLISION, FARTHEST_PERSON, NO_HIT
from acsar_gym.worlds.world import point_in_world, to_odometry

Info = dict[str, Any]
Step = tuple[Observation, float, bool, bool, Info]
UNKNOWN_POSE: Pose = (math.nan, math.nan, math.nan)
"""The true pose on links without ground truth."""


class EnvOptions(SharedOptions):
    """The options of a single environment. `RobotEnv` describes them."""

    render_mode: Literal["human", "rgb_array"] | None = None
    lidar: Any = None
    view: Literal["top", "camera"] = "top"
    on_fault: Literal["raise", "truncate"] = "truncate"
    record: Any = None


class RobotEnv(PlainSpec, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A four-wheel skid-steer robot with a task. This is what all ids share.

    `acsar_gym.envs` has a class for each registered id, whose docstring describes observation,
    reward, start and end: `help(acsar_gym.envs.PointGoalEnv)`.

    ## Action space

    `Box(-1, 1, (2,), float32)`, held for one step (100 ms by default):

    | index | action | full scale |
    |---|---|---|
    | 0 | linear velocity, forward positive | `max_linear` of the robot, 0.5 m/s |
    | 1 | angular velocity, counter-clockwise positive | `max_angular` of the robot, 1.5 rad/s |

    Finite values outside are clipped. NaN, infinity, a wrong shape or values that aren't numbers
    (such as a tensor that requires grad) raise CommandError after the wheels have been commanded
    to stop.

    ## Reward

    The sum of terms with weights. `weights={"near": 0.3}` changes some of them. `reward_threshold`
    is about 90 % of the mean `episode_return` of the id's packaged policy. The ids with people
    have none.

    ## Start and end

    The step that ends an episode commands the wheels to stop, and a step after it is a ConfigError.
    On hardware, reset stops the robot, waits for standstill and sets the odometry to zero.

    ## Arguments

    - `link`: "bullet", "planar", "mujoco", a serial device such as "/dev/ttyUSB0",
      "socket://host:port", "replay:FILE", or a Link. See `open_link`.
    - `robot`: A RobotConfig, its fields in a mapping (as in the env's spec), a preset's name, or a
      .yaml or .urdf file. None is the ACSAR robot.
    - `weights`: Weights of the reward by name, instead of the defaults.
    - `worlds`: A set of generated worlds such as "clutter:train": "clutter:50" means the first 50,
      "clutter:100-149" those with these numbers, "clutter" the training split, and so on for the
      other kinds ("open", "rooms", "barn") and those that `acsar_gym.worlds.register` adds. Or a
      file (.world, .sdf, ROS map, .json, .yaml), a folder of them, a World, or a list of World. Or
      a file with what it doesn't contain, {"path": "hall.sdf", "start": (0, 0, 1.57), "goal":
      (4, 0)}. A list such as ["clutter:train", "barn:train"] has the worlds of several sets:
      `info` has no number then, and `options={"world": "clutter 1017"}` chooses a world by its
      name.
    - `difficulty`: Difficulty of generated worlds, 0 to 1. None or a range (low, high) varies it.
    - `lidar`: None for the simulated LiDAR, model and device like "rplidar:///dev/ttyUSB1" on
      hardware, "module:Class", or a Lidar.
    - `max_episode_steps`: Time limit [steps]. None or -1 is none. `gymnasium.make` passes it to its
      TimeLimit wrapper, which the env finds.
    - `policy_rate`: Steps per second [Hz]. The robot's control rate must be a whole multiple.
    - `render_mode`: "rgb_array", or "human" for a live window, in real time. Without a display it
      draws off-screen, with a warning.
    - `view`: "top", drawn from above for every link, or "camera", the simulator's behind the robot.
    - `faults`: Lines between driver and board that are lost or late, such as {"dropped_lines": 0.1,
      "late_lines": 0.05}. See `acsar_gym.links.faults.Faults`. Drawn from the env's generator.
    - `sensors`: More sensors, such as [ThreeRays] or ["mine.rays:ThreeRays"], subclasses of
      `acsar_gym.Sensor`. Their numbers follow in the observation.
    - `randomization`: What a simulated robot draws for every episode, such as {"friction":
      (0.7, 1.2), "latency": (0.0, 0.02)}. See `acsar_gym.physics.Randomization`. True: what
      `acsar-gym train` randomizes.
    - `on_fault`: "truncate" ends an episode in which the link or the board fails, with a number in
      info's `fault` (0 none, 1 silent, 2 garbled, 3 link lost, 4 LiDAR, 5 other, 6 a wheel that
      contradicts its commands, reported at every step on hardware and with `faults`) and the whole
      message in `fault_reason`. The next reset opens the link again. "raise" raises the LinkError.
    - `record`: File to which the whole drive is recorded (MCAP: topics of ROS 2, the raw wire, and
      what the policy saw and did). `link="replay:FILE"` plays it back. `close()` ends the file.

    ## Info

    The same floats at every step: `goal_distance` [m] and `is_success` by odometry, `odom_x`,
    `odom_y`, `odom_theta`, `feedback_age` [s]. `sent_linear` [m/s] and `sent_angular` [rad/s], the
    twist that was sent in the last tick, and `sent_reason`, why it differs from the action (0 it
    doesn't, 1 limits, 2 geofence, 3 stale feedback, 4 emergency stop). What only a simulator
    knows: `true_x`, `true_y`, `true_theta`, `true_goal_distance`, `true_contact` (whether the robot
    has touched something), and `odometry_error` [m], the distance between odometry and truth. Those
    are NaN on hardware. Everything is in the odometry frame. `drawn_` and the name of a randomized
    parameter report what the episode has drawn, as applied: `drawn_motor_gain` and
    `drawn_motor_lag` are arrays of four, in the order of the wheels.

    In worlds: `world`, the generator's number ("clutter 1017" is 1017), the place in a folder or
    list, from 0, or -1 for a World given to reset. With a LiDAR: `scan_age` [s] and `scan_stale`
    (1 for a scan older than two periods of the LiDAR). A scan older than `lidar.timeout` stops the
    robot with LidarError.

    In worlds that move, NaN on hardware: `closest_person` [m], from the robot's hull to the nearest
    person's now, 0 to 100. `time_to_collision` [s], until the circle around the robot would touch a
    person if all kept their velocities, 0 to 10. `intrusions`, how often the robot has come within
    0.45 m of a person so far. `person_contact`: 0 none, 1 the robot ran into a person, 2 a
    person ran into the robot.

    ## Version history

    - ObstacleGoal-v1, Barn-v1: a map that remembers comes before the rays. The reward is for the
      way over it and includes the footprint's clearance. An episode of ObstacleGoal is truncated
      after 600 steps instead of 400.
    - v0 of all ids: first version.

    Attributes:
        task: The task.
        robot: The driver.
        pool: The worlds. None on an open floor.

    Example:
        >>> import acsar_gym
        >>> env = acsar_gym.RobotEnv("acsar_gym.tasks:PointGoal", link="planar")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape
        (7,)
        >>> env.close()
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium.Env declares it
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        task: Task | type[Task] | str,
        link: str | Link = "bullet",
        robot: RobotSource = None,
        **options: Any,
    ) -> None:
        """Make the environment. Nothing is opened before the first reset.

        Args:
            task: A task, its class, or "module:Class".
            link: The wire to the robot, see the class.
            robot: Robot configuration, see the class.
            **options: Options of the env, see the class, and of the task.

        Raises:
            ConfigError, WorldError: Options are unknown, or values out of range.
            MissingExtraError: What the link, `record` or `render_mode` need isn't installed.
        """
        self._options, task_options = EnvOptions.split(options)
        config = RobotConfig.of(robot)
        rate = self._options.policy_rate
        self.render_mode = self._options.render_mode
        # Recorders read the rate of pictures here.
        self.metadata = {**type(self).metadata, "render_fps": rate}
        self.ticks_per_step = whole_ratio("control_rate", config.control_rate, "policy_rate", rate)

        # The task, and where its episodes take place.
        self.task = make_task(task, task_options, EnvOptions.names())
        self._spawn = Spawn(self.task, self._options.worlds, self._options.difficulty, config)
        self.pool = self._spawn.pool
        self._has_movers = self.pool is not None and self.pool.moves
        self._check = ObservationCheck(self.task)

        self._connect(link, config)
        self.action_space: Any
        self.observation_space: Any
        self.action_space, self.observation_space = task_spaces(self.task, self.sensors)

        # The running episode.
        self._max_steps = read_step_limit(self._options.max_episode_steps) or math.inf
        self._limits: list[weakref.ref[Any]] = []
        self._episode: RunningEpisode | None = None
        self._has_ended = False
        self._last_step: tuple[Observation, Info] | None = None

    def _connect(self, link: Any, config: RobotConfig) -> None:
        """Make link, robot, sensors and screen. Opens nothing."""
        chosen = self._options
        step_time = self.ticks_per_step * config.period
        simulator = BodyBackend("", "", has_camera=not isinstance(link, str))  # of other links
        if isinstance(link, str):
            simulator = BODIES.get(link, simulator)

        # What it looks like.
        is_human = self.render_mode == "human"
        own_window = is_human and simulator.has_window and body.has_display()
        if chosen.view == "camera" and not simulator.has_camera:
            raise ConfigError(
                f"link {link!r} has no camera; view='camera' needs link {LINKS_WITH_CAMERA}"
            )

        # PyBullet's own window needs no Pillow.
        if self.render_mode is not None and chosen.view == "top" and not own_window:
            check_extra("pictures", "pictures", "PIL")
        self._screen = Screen(config, None if own_window else self.render_mode, chosen.view)

        # The link, and what differs from an ideal one.
        if not isinstance(link, Link):
            link = open_link(link, config, window=own_window, realtime=is_human)
        is_simulated = link.truth is not None
        self._randomizer = Randomizer(
            chosen.randomization,
            config,
            step_time,
            simulated=is_simulated,
            unused=simulator.unused,
        )
        faults = Faults.of(chosen.faults)
        self._faulty = FaultyLink(link, faults) if faults.possible else None

        # The robot, and who observes it.
        self._recorder = Recorder.of(chosen.record) or DriveObserver()
        sensors = (*self.task.sensors, *chosen.sensors)
        if chosen.lidar is not None and LIDAR not in sensors:
            raise ConfigError(
                f"lidar = {show_value(chosen.lidar)}: {task_name(self.task)} uses none"
            )
        factories = sensor_factories(sensors, chosen.lidar, step_time)
        self.robot = Robot(self._faulty or link, config, factories, self._recorder)
        self._max_twist = (config.max_linear, config.max_angular)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode. Opens link and sensors the first time.

        Args:
            seed: Seed of the env's generator. None keeps the generator.
            options: Options of the episode, such as "goal" and "world". See the class of the id.

        Returns:
            The first observation, (numbers,) float32, and info.

        Raises:
            ConfigError, WorldError: Options are unknown, or values out of range.
            LinkError: The link can't be opened, or the board or a sensor doesn't answer.
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        self._halt()
        self._last_step = None
        # Wrappers are added after the env was made, so they are looked for at each reset.
        self._limits = find_limits(self)
        super().reset(seed=int(seed) if isinstance(seed, np.integer) else seed)

        # Draw what differs between episodes.
        if self._faulty is not None:
            self._faulty.seed(self.np_random)
        assignment = self._spawn.draw(self.np_random, {} if options is None else options)
        physics = self._randomizer.draw(self.np_random)
        self._episode = RunningEpisode(self.task, assignment, self._check)
        self._has_ended = False

        # Place the robot there.
        start = assignment.start
        goal = point_in_world(start, assignment.goal)
        self._describe_episode(seed, assignment)
        self.robot.reset(
            Scene(start, goal, assignment.world, physics, assignment.key), self.np_random
        )
        sensed = self.robot.read().astype(np.float32)
        self._screen.begin(assignment, self.task.goal_tolerance)

        # The task or a sensor may fail.
        try:
            state, truth = self._observe(self._episode, (0.0, 0.0), sensed)
            self._episode.begin(state)
            observation, info = self._describe_step(self._episode, state, truth)
            self._recorder.after_step(self.robot, StepResult(0, observation))
        except BaseException as error:
            self.robot.deactivate(error)
            raise
        return observation, info

    def step(self, action: NDArray[np.floating]) -> Step:
        """Drive for one env step. The class of the id describes spaces, reward and end.

        With the step that ends the episode, by the task or the time limit, the wheels are commanded
        to stop.

        Args:
            action: (2,), linear and angular, clipped to [-1, 1].

        Returns:
            Observation (numbers,) float32, reward, terminated, truncated and info.

        Raises:
            CommandError: The action has another shape, NaN or infinity, or isn't numbers. The
                wheels are commanded to stop.
            ConfigError: The episode hasn't begun, or has ended. The wheels are commanded to stop.
            LinkError: The link or the board fails and `on_fault` is "raise".
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        episode = self._require_running()
        action, twist = self._read_action(action)

        try:
            sensed = self._drive(twist)
        except LinkError as error:
            return self._end_by_fault(episode, action, error)

        # Steps that a fault ends aren't counted.
        episode.steps += 1

        try:
            state, truth = self._observe(episode, twist, sensed)
            reward, outcome = episode.step(state)
            observation, info = self._describe_step(episode, state, truth)
        except BaseException as error:
            self.robot.deactivate(error)
            raise

        terminated, truncated = self._find_end(episode)
        is_success = outcome is Outcome.SUCCESS
        result = StepResult(
            episode.steps, observation, reward, terminated, truncated, is_success=is_success
        )
        self._recorder.after_step(self.robot, result, action)
        return observation, reward, terminated, truncated, info

    def _require_running(self) -> RunningEpisode:
        """Return the episode. If it has ended, stop the wheels and raise ConfigError."""
        if self._episode is None:
            raise ConfigError("step() before reset(): call reset() first")
        if self._has_ended:
            self._halt()
            raise ConfigError("step() after the end of the episode: call reset() first")
        return self._episode

    def _read_action(self, action: Any) -> tuple[NDArray[np.float64], Twist]:
        """Return an action as an array, and clipped. Stops the wheels if it can't be read."""
        try:
            numbers = read_actions(action, (2,))
        except BaseException:
            self._halt()
            raise
        linear, angular = numbers.tolist()
        return numbers, (min(max(linear, -1.0), 1.0), min(max(angular, -1.0), 1.0))

    def _drive(self, action: Twist) -> Observation:
        """Drive for the ticks of a step, and return what the sensors read then."""
        linear = action[0] * self._max_twist[0]
        angular = action[1] * self._max_twist[1]

        # One command for all ticks. Sensors are read after the last tick.
        for _ in range(self.ticks_per_step):
            self.robot.drive(linear, angular)
        return self.robot.read().astype(np.float32)

    def _end_by_fault(
        self, episode: RunningEpisode, action: NDArray[np.float64], error: LinkError
    ) -> Step:
        """Truncate the episode with the last observation, or raise the error."""
        # Before the first observation there is nothing that could be returned.
        if self._last_step is None or self._options.on_fault == "raise":
            raise error

        # Nothing was observed since: the last observation is the newest.
        self.robot.deactivate(error)
        observation, info = self._last_step
        self._last_step = None

        info |= self._randomizer.info()
        info |= {"is_success": 0.0, "fault": error.fault, "fault_reason": str(error)}
        result = StepResult(episode.steps + 1, observation, reward=0.0, truncated=True)
        self._recorder.after_step(self.robot, result, action)
        return observation, 0.0, False, True, info

    def _find_end(self, episode: RunningEpisode) -> tuple[bool, bool]:
        """Whether the episode has terminated or been truncated. The wheels stop at its end."""
        # A wrapper's limit ends the episode, too, and the wheels must not run on meanwhile.
        terminated = episode.outcome is not Outcome.GOING
        truncated = episode.steps >= self._max_steps or any(map(is_last_step, self._limits))
        if terminated or truncated:
            self._has_ended = True
            self._halt()
        return terminated, truncated

    def _halt(self) -> None:
        """Stop the wheels between episodes.

        A link that is lost is closed, and the next reset opens it.
        """
        try:
            self.robot.stop()
        except LinkError as error:
            self.robot.deactivate(error)

    def _describe_episode(self, seed: int | None, assignment: Assignment) -> None:
        """Tell the robot's observer about the env, and the episode that begins."""
        about = {}
        if self.spec is not None:
            # The recording of a drive doesn't depend on the device or the file.
            kwargs = {k: v for k, v in self.spec.kwargs.items() if k not in ("link", "record")}
            about = {"id": self.spec.id, "kwargs": kwargs}

        episode = {
            "seed": seed,
            "goal": list(assignment.goal),
            "start": list(assignment.start),
            "world": None if assignment.world is None else assignment.world_key,
        }
        self._recorder.describe(
            episode,
            env=about,
            task=task_name(self.task),
            observation=list(self.task.observation),
        )

    def _observe(
        self, episode: RunningEpisode, action: Twist, sensed: Observation
    ) -> tuple[State, GroundTruth | None]:
        """The robot's new state, and what the simulator knows. Also shown on the screen."""
        robot = self.robot
        assignment = episode.assignment
        truth = robot.link.truth
        scan = newest_scan(robot.sensors)
        period = robot.config.period

        state = State(
            pose=robot.odometry.pose,
            twist=robot.odometry.twist,
            wheel_speeds=robot.speeds,
            action=action,
            sent=robot.safety.sent,
            reason=int(robot.safety.reason),
            ranges=NO_RANGES if scan is None else scan.ranges,
            edges=NO_RANGES if scan is None else footprint_edges(robot.config),
            sensed=sensed,
            time=episode.steps * self.ticks_per_step * period,
            feedback_age=robot.feedback_age,
            contact=truth is not None and truth.contact,
            goal=assignment.goal,
            path=NO_PATH if assignment.path is None else assignment.path,
            length=assignment.length,
            max_twist=self._max_twist,
            period=self.ticks_per_step * period,
        )
        self._screen.show(state, truth, scan)
        return state, truth

    def _describe_step(
        self, episode: RunningEpisode, state: State, truth: GroundTruth | None
    ) -> tuple[Observation, Info]:
        """Observation and info after a reset or step."""
        observation = np.concatenate([episode.observe(state), state.sensed])
        info: Info = _step_info(episode, state, truth)._asdict()
        if self._has_movers:
            info |= survey_movers(truth)._asdict()
        info |= episode.info() | self._randomizer.info()

        # Only these can fail, and info has the same keys at every step.
        if self._faulty is not None or truth is None:
            info["fault"] = 0.0
        self.robot.add_sensor_info(info)
        self._last_step = (observation.copy(), info.copy())  # a caller may change its own
        return observation, info

    @property
    def sensors(self) -> Sequence[Sensor]:
        """The robot's sensors, in the order of their numbers in the observation."""
        return self.robot.sensors

    @property
    def episode(self) -> RunningEpisode:
        """The current episode.

        Raises:
            ConfigError: There was no reset.
        """
        if self._episode is None:
            raise ConfigError("there is no episode before reset(): call it first")
        return self._episode

    def render(self) -> Image | None:
        """Return a picture in mode rgb_array, (height, width, 3) uint8. None in other modes.

        Raises:
            ConfigError: There was no reset.
        """
        # In mode human the window is updated with each step.
        if self.render_mode != "rgb_array":
            return None
        if not self.robot.active:
            raise ConfigError("there is nothing to see before reset(): call it first")
        return self._screen.picture(self.robot.link)

    def close(self) -> None:
        """Stop the wheels, close link, sensors and window. Idempotent."""
        self._last_step = None
        try:
            self.robot.close()
        finally:
            self._screen.close()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have a robot of their own and must be reset first."""
        return self.__dict__ | {"_episode": None, "_last_step": None, "_limits": []}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy of a recorded env is recorded, although a copy of a robot isn't observed."""
        self.__dict__.update(state)

        # Copies of a robot have no observer.
        if self._options.record is not None:
            robot = self.robot
            self.robot = Robot(robot.link, robot.config, tuple(robot.sensors), self._recorder)

    def __copy__(self) -> Self:
        """Every copy is a deep one, because two environments can't share a robot."""
        return copy.deepcopy(self)

    def __del__(self, is_finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        if is_finalizing():  # wheels have been stopped at exit, and modules are partly gone
            return
        if getattr(self, "robot", None) is not None and hasattr(self, "_screen"):
            with contextlib.suppress(AcsarError):
                self.close()


def _step_info(episode: RunningEpisode, state: State, truth: GroundTruth | None) -> StepInfo:
    """What every task has in info."""
    x, y, theta = state.pose
    goal_x, goal_y = state.goal
    start = episode.assignment.start
    # The simulator knows the frame of the world, and info is in that of odometry.
    true_x, true_y, true_theta = to_odometry(start, truth.pose) if truth else UNKNOWN_POSE

    return StepInfo(
        is_success=float(episode.outcome is Outcome.SUCCESS),
        odom_x=x,
        odom_y=y,
        odom_theta=theta,
        feedback_age=state.feedback_age,
        sent_linear=state.sent[0],
        sent_angular=state.sent[1],
        sent_reason=float(state.reason),
        true_x=true_x,
        true_y=true_y,
        true_theta=true_theta,
        true_contact=float(truth.contact) if truth else math.nan,
        true_goal_distance=math.hypot(goal_x - true_x, goal_y - true_y),
        odometry_error=math.hypot(true_x - x, true_y - y),
    )


def survey_movers(truth: GroundTruth | None) -> CrowdInfo:
    """What info has of those who move. NaN if no simulator knows them."""
    if truth is None:
        return CrowdInfo(math.nan, math.nan, math.nan, person_contact=math.nan)
    crowd = truth.crowd
    if crowd is None:
        return CrowdInfo(FARTHEST_PERSON, FARTHEST_COLLISION, 0.0, person_contact=NO_HIT)
    closest, soonest = crowd.survey(truth.pose, truth.twist)
    return CrowdInfo(closest, soonest, crowd.intrusions, person_contact=crowd.hit)

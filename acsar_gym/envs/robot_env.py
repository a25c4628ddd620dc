"""The Gymnasium environment: one class for all tasks, in simulation and on hardware."""

from __future__ import annotations

import contextlib
import copy
import math
import os
import sys
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Literal, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, RobotSource, whole_ratio
from acsar_gym.envs.time_limit import find_limits, is_last_step
from acsar_gym.errors import (
    AcsarError,
    BoardGarbledError,
    BoardSilentError,
    ConfigError,
    LidarError,
    LinkError,
    LinkLostError,
    WheelError,
    check_extra,
    show_value,
)
from acsar_gym.links import Link, open_link
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.physics import body
from acsar_gym.physics.bodies import BODIES, LINKS_WITH_CAMERA
from acsar_gym.physics.body import Image
from acsar_gym.physics.randomization import Randomizer
from acsar_gym.recording import Recorder
from acsar_gym.recording.events import Stepped
from acsar_gym.render.renderer import Screen
from acsar_gym.robot import Robot
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.sensors.lidar import footprint_edges, newest_scan
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.tasks import Observation, Outcome, State, Task
from acsar_gym.tasks.actions import read_actions
from acsar_gym.tasks.episode import Assignment, ObservationCheck, RunningEpisode, Spawn
from acsar_gym.tasks.factory import make_task, task_name, validate_task
from acsar_gym.tasks.options import SharedOptions, read_step_limit
from acsar_gym.tasks.spec import PlainSpec, task_spaces
from acsar_gym.tasks.state import CROWD_INFO, INFO, NO_PATH, NO_RANGES, NOTHING_SENSED, write_maker
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.crowd import FARTHEST_COLLISION, FARTHEST_PERSON, NO_HIT
from acsar_gym.worlds.world import point_in_world, to_odometry

Info = dict[str, Any]
FAULT_CODES = (
    (BoardGarbledError, 2),
    (BoardSilentError, 1),
    (LinkLostError, 3),
    (LidarError, 4),
    (WheelError, 6),
    (LinkError, 5),
)
"""Numbers of errors in info's `fault`; subclasses come first."""
LARGEST = float(np.finfo(np.float32).max)  # largest number of an action in a recording
UNKNOWN_POSE: Pose = (math.nan, math.nan, math.nan)  # the true pose on links without ground truth
Numbers = dict[str, Any]
"""Numbers of the robot, by the names that State and info have in `tasks.state`."""
make_state = write_maker(lambda name: f'{"*" * (name == "read_speed")}numbers["{name}"]')


class EnvOptions(SharedOptions):
    """The options of a single environment.

    The manual of `acsar_gym/PointGoal-v0` describes them.
    """

    render_mode: Literal["human", "rgb_array"] | None = None
    lidar: Any = None
    view: Literal["top", "camera"] = "top"
    on_fault: Literal["raise", "truncate"] = "truncate"
    record: Any = None


class RobotEnv(PlainSpec, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A four-wheel skid-steer robot with a task; the manuals of the ids are in `acsar_gym.envs`.

    Attributes: `task`; `robot`, the driver; `episode`, the current episode's assignment and memory;
    `pool`, the worlds, None on an open floor.
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
        """Make the environment; nothing is opened before the first reset.

        Args:
            task: a task, its class, or "module:Class".
            link: "bullet", "planar", "mujoco", a serial device, a URL, or a Link; see `open_link`.
            robot: its configuration; see `RobotConfig.of`.
            **options: of the env (see `EnvOptions` and the manual of PointGoal), and the task's.

        Raises:
            ConfigError, WorldError: for unknown options, or values out of range.
            ConfigError: where a method of the task raises an error, or returns what can't be used.
            MissingExtraError: what the link, `record` or `render_mode` need isn't installed.
        """
        config = RobotConfig.of(robot)
        self._options, task_options = EnvOptions.split(options)
        rate = self._options.policy_rate
        self.render_mode = self._options.render_mode
        self.ticks_per_step = whole_ratio("control_rate", config.control_rate, "policy_rate", rate)
        self.metadata = {**type(self).metadata, "render_fps": rate}
        self.task = make_task(task, task_options, EnvOptions.names())
        self._spawn = Spawn(self.task, self._options.worlds, self._options.difficulty, config)
        self.pool = self._spawn.pool
        self._moves = self.pool is not None and self.pool.moves
        self._info = INFO | CROWD_INFO if self._moves else INFO
        self._connect(link, config)
        validate_task(self.task, config, self.sensors)
        self.action_space: Any
        self.observation_space: Any
        self.action_space, self.observation_space = task_spaces(self.task, self.sensors)
        self._max_steps = read_step_limit(self._options.max_episode_steps) or math.inf
        self._limits: list[weakref.ref[Any]] = []
        self._observed = ObservationCheck(self.task)
        self._episode: RunningEpisode | None = None
        self._has_ended = False
        self._sensed: Observation = NOTHING_SENSED
        self._last_step: tuple[Observation, Info] | None = None

    def _connect(self, link: Any, config: RobotConfig) -> None:
        """Make the robot with its link and sensors, and the screen; opens nothing."""
        chosen = self._options
        human = self.render_mode == "human"
        simulator = BODIES.get(link) if isinstance(link, str) else None
        has_camera = simulator.has_camera if simulator else not isinstance(link, str)
        if chosen.view == "camera" and not has_camera:
            raise ConfigError(
                f"link {link!r} has no camera; view='camera' needs link {LINKS_WITH_CAMERA}"
            )
        sensors = (*self.task.sensors, *chosen.sensors)
        if chosen.lidar is not None and LIDAR not in sensors:
            raise ConfigError(
                f"lidar = {show_value(chosen.lidar)}: {task_name(self.task)} uses none"
            )
        has_own_window = simulator is not None and simulator.has_window
        own_window = human and has_own_window and body.has_display()
        if isinstance(link, str | os.PathLike) or not isinstance(link, Link):
            link = open_link(link, config, window=own_window, realtime=human)
        step = self.ticks_per_step * config.period
        simulated = link.truth is not None
        unused = simulator.unused if simulator else ()
        self._randomizer = Randomizer(
            chosen.randomization, config, step, simulated=simulated, unused=unused
        )
        faults = Faults.of(chosen.faults)
        self._faulty = FaultyLink(link, faults) if faults.possible else None
        self._recorder = Recorder.of(chosen.record)
        if isinstance(chosen.record, str | os.PathLike):
            check_extra("recording", "record", "mcap", "rosbags")
        if self.render_mode is not None and chosen.view == "top" and not own_window:
            check_extra("pictures", "pictures", "PIL")
        factories = sensor_factories(sensors, chosen.lidar, step)
        self.robot = Robot(self._faulty or link, config, factories, self._recorder)
        self._top = (config.max_linear, config.max_angular)
        self._screen = Screen(config, None if own_window else self.render_mode, chosen.view)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode; opens link and sensors the first time.

        Args:
            seed: of the env's generator; None goes on with the one that there is.
            options: see the class of the id, such as "goal" and "world".

        Returns:
            The first observation, (numbers,) float32, and info.

        Raises:
            ConfigError, WorldError: for unknown options, or values out of range.
            LinkError: where the link can't be opened, or the board or a sensor doesn't answer.
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        self._halt()
        self._last_step = None
        super().reset(seed=int(seed) if isinstance(seed, np.integer) else seed)
        self._limits = find_limits(self)
        if self._faulty is not None:
            self._faulty.seed(self.np_random)
        assignment = self._spawn.draw(self.np_random, {} if options is None else options)
        self._episode = episode = RunningEpisode(self.task, assignment, self._observed)
        self._has_ended = False
        start, physics = assignment.start, self._randomizer.draw(self.np_random)
        goal = point_in_world(start, assignment.goal)
        scene = Scene(start, goal, assignment.world, physics, assignment.key)
        self._describe_episode(seed, assignment)
        self.robot.reset(scene, self.np_random)
        self._sensed = self.robot.read().astype(np.float32)
        self._screen.begin(assignment, self.task.goal_tolerance)
        try:
            numbers, state = self._observe(episode, (0.0, 0.0))
            episode.begin(state)
            observation, info = self._describe_step(episode, state, numbers)
            self._record_step(0, observation)
        except BaseException as error:
            self.robot.deactivate(error)
            raise
        return observation, info

    def step(self, action: NDArray[np.floating]) -> tuple[Observation, float, bool, bool, Info]:
        """Drive for one env step; the class of the id describes spaces, reward and end.

        With the step that ends the episode, by the task or the time limit, the wheels are commanded
        to stop.

        Args:
            action: (2,), linear and angular, clipped to [-1, 1].

        Returns:
            Observation (numbers,) float32, reward, terminated, truncated and info.

        Raises:
            CommandError: for another shape, NaN, infinity, or what isn't numbers; the wheels are
                commanded to stop.
            ConfigError: before the first reset, or after the end of an episode; the wheels are
                commanded to stop.
            LinkError: where the link or the board fails and `on_fault` is "raise".
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        episode = self._episode
        if episode is None:
            raise ConfigError("step() before reset(): call reset() first")
        if self._has_ended:
            self._halt()
            raise ConfigError("step() after the end of the episode: call reset() first")
        try:
            action = read_actions(action, (2,))
        except BaseException:
            self._halt()
            raise
        linear, angular = (min(max(number, -1.0), 1.0) for number in action.tolist())
        try:
            for _ in range(self.ticks_per_step):
                self.robot.drive(linear * self._top[0], angular * self._top[1])
            self._sensed = self.robot.read().astype(np.float32)
        except LinkError as error:
            if self._last_step is None or self._options.on_fault == "raise":
                raise
            self.robot.deactivate(error)
            (observation, info), self._last_step = self._last_step, None
            code = next(code for kind, code in FAULT_CODES if isinstance(error, kind))
            why = {"is_success": 0.0, "fault": float(code), "fault_reason": str(error)}
            ends = False, True, False
            self._record_step(episode.steps + 1, observation, action, 0.0, ends)
            return observation, 0.0, False, True, info | self._randomizer.info() | why
        episode.steps += 1
        try:
            numbers, state = self._observe(episode, (linear, angular))
            reward, outcome = episode.step(state)
            observation, info = self._describe_step(episode, state, numbers)
        except BaseException as error:
            self.robot.deactivate(error)
            raise
        terminated = outcome is not Outcome.GOING
        truncated = episode.steps >= self._max_steps or any(map(is_last_step, self._limits))
        if terminated or truncated:
            self._has_ended = True
            self._halt()
        ends = terminated, truncated, info["is_success"] == 1.0
        self._record_step(episode.steps, observation, action, reward, ends)
        return observation, reward, terminated, truncated, info

    def _halt(self) -> None:
        """Stop the wheels between episodes.

        A link that is lost is closed, and the next reset opens it.
        """
        try:
            self.robot.stop()
        except LinkError as error:
            self.robot.deactivate(error)

    def _describe_episode(self, seed: int | None, assignment: Assignment) -> None:
        """Tell the recorder, if there is one, about the env, and the episode that begins."""
        if self._recorder is None:
            return
        about = {}
        if self.spec is not None:
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

    def _record_step(
        self,
        step: int,
        observation: Observation,
        action: NDArray[np.floating] | None = None,
        reward: float = math.nan,
        ends: tuple[bool, bool, bool] = (False, False, False),
    ) -> None:
        """Record a step, or step 0, the reset; `ends`: terminated, truncated, success."""
        if self._recorder is not None:
            now, seen = self.robot.link.now(), observation.copy()
            if action is not None:
                action = np.clip(action, -LARGEST, LARGEST).astype(np.float32)
            self._recorder.add(Stepped(step, now, seen, action, reward, *ends))

    def _observe(
        self, episode: RunningEpisode, action: tuple[float, float]
    ) -> tuple[Numbers, State]:
        """The numbers of which State and info are made, and the State; also shown on the screen."""
        robot, assignment, config = self.robot, episode.assignment, self.robot.config
        truth, scan = robot.link.truth, newest_scan(robot.sensors)
        x, y, theta = robot.odometry.pose
        linear, angular = robot.odometry.twist
        sent_linear, sent_angular = robot.safety.sent
        goal_x, goal_y = assignment.goal
        pose = to_odometry(assignment.start, truth.pose) if truth else UNKNOWN_POSE
        true_x, true_y, true_theta = pose
        numbers = {
            "odom_x": x,
            "odom_y": y,
            "odom_theta": theta,
            "linear": linear,
            "angular": angular,
            "read_speed": robot.speeds,
            "action_linear": action[0],
            "action_angular": action[1],
            "sent_linear": sent_linear,
            "sent_angular": sent_angular,
            "reason": float(robot.safety.reason),
            "age": robot.feedback_age,
            "contact": float(truth.contact) if truth else math.nan,
            "goal_x": goal_x,
            "goal_y": goal_y,
            "max_linear": self._top[0],
            "max_angular": self._top[1],
            "x": true_x,
            "y": true_y,
            "true_theta": true_theta,
            "goal_distance": math.hypot(goal_x - true_x, goal_y - true_y),
            "odom_error": math.hypot(true_x - x, true_y - y),
        }
        if self._moves:
            numbers |= survey_movers(truth)
        state = make_state(
            numbers,
            0,
            NO_RANGES if scan is None else scan.ranges,
            NO_RANGES if scan is None else footprint_edges(config),
            self._sensed,
            episode.steps * self.ticks_per_step * config.period,
            NO_PATH if assignment.path is None else assignment.path,
            assignment.length,
            self.ticks_per_step * config.period,
        )
        self._screen.show(state, truth, scan)
        return numbers, state

    def _describe_step(
        self, episode: RunningEpisode, state: State, numbers: Numbers
    ) -> tuple[Observation, Info]:
        """Observation and info after a reset or step."""
        observation = np.concatenate([episode.observe(state), state.sensed])
        numbers["success"] = float(episode.outcome is Outcome.SUCCESS)
        info = {key: numbers[name] for key, name in self._info.items()}
        info |= episode.info() | self._randomizer.info()
        if self._faulty is not None or math.isnan(numbers["contact"]):  # no simulator's truth
            info["fault"] = 0.0
        self.robot.add_sensor_info(info)
        self._last_step = observation.copy(), info.copy()  # a caller may change its own
        return observation, info

    @property
    def sensors(self) -> Sequence[Sensor]:
        """The robot's sensors, in the order of their numbers in the observation."""
        return self.robot.sensors

    @property
    def episode(self) -> RunningEpisode:
        """The current episode.

        Raises:
            ConfigError: before the first reset.
        """
        if self._episode is None:
            raise ConfigError("there is no episode before reset(): call it first")
        return self._episode

    def render(self) -> Image | None:
        """Return a picture in mode rgb_array, (height, width, 3) uint8; None in other modes.

        Raises:
            ConfigError: before the first reset.
        """
        if self.render_mode != "rgb_array":
            return None
        if not self.robot.active:
            raise ConfigError("there is nothing to see before reset(): call it first")
        return self._screen.picture(self.robot.link)

    def close(self) -> None:
        """Stop the wheels, close link, sensors and window; idempotent."""
        self._last_step = None
        try:
            self.robot.close()
        finally:
            self._screen.close()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have a robot of their own and must be reset first."""
        return self.__dict__ | {"_episode": None, "_last_step": None, "_limits": []}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy of a recorded env is recorded, too: copies of robots aren't."""
        self.__dict__.update(state)
        if self._recorder is not None:
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


def survey_movers(truth: GroundTruth | None) -> Numbers:
    """The numbers of `CROWD_INFO`; NaN where no simulator knows them."""
    if truth is None:
        return dict.fromkeys(CROWD_INFO.values(), math.nan)
    closest, soonest, intrusions, hit = FARTHEST_PERSON, FARTHEST_COLLISION, 0.0, NO_HIT
    if (crowd := truth.crowd) is not None:
        closest, soonest = crowd.survey(truth.pose, truth.twist)
        intrusions, hit = crowd.intrusions, crowd.hit
    return dict(zip(CROWD_INFO.values(), (closest, soonest, intrusions, hit), strict=True))

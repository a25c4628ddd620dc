"""The Gymnasium environment: one class for all tasks, in simulation and on hardware."""

from __future__ import annotations

import contextlib
import copy
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies import display
from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.config import RobotConfig, RobotSource, whole_ratio
from acsar_gym.dynamics.randomization import Randomizer
from acsar_gym.envs.actions import checked
from acsar_gym.envs.options import RENDER_MODES, EnvOptions
from acsar_gym.envs.recording import EnvRecord
from acsar_gym.envs.told import Info, fault_code, info_of, observed, state_of
from acsar_gym.errors import AcsarError, CommandError, ConfigError, LinkError, RenderError
from acsar_gym.lidars.base import newest_scan
from acsar_gym.links import Link, open_link
from acsar_gym.links.fault_injection import FaultyLink
from acsar_gym.links.faults import Faults
from acsar_gym.render.renderer import Screen
from acsar_gym.robot import Robot
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Outcome, State, Task
from acsar_gym.tasks.base import NOTHING_SENSED
from acsar_gym.tasks.episode import Episode
from acsar_gym.tasks.made import made, tried
from acsar_gym.tasks.spaces import task_spaces
from acsar_gym.tasks.spawn import Spawn
from acsar_gym.vector.specs import PlainSpec
from acsar_gym.worlds import Scene
from acsar_gym.worlds.scene import point_in_world


class RobotEnv(PlainSpec, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A four-wheel skid-steer robot with a task; the manuals of the ids are in `acsar_gym.envs`.

    Attributes: `task`; `robot`, the driver; `episode`, the current episode's assignment and memory;
    `pool`, the worlds, None on an open floor.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium.Env declares it
        "render_modes": list(RENDER_MODES),
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
            link: "bullet", "planar", a serial device, a URL, or a Link; see `open_link`.
            robot: its configuration; see `RobotConfig.of`.
            **options: of the env (see `EnvOptions` and the manual of PointGoal), and the task's.

        Raises:
            ConfigError, RenderError, WorldError: for unknown options, or values out of range.
        """
        config = RobotConfig.of(robot)
        self._options, rest = EnvOptions.split(options)
        rate = self._options.policy_rate
        self.render_mode = self._options.render_mode
        self.ticks_per_step = whole_ratio("control_rate", config.control_rate, "policy_rate", rate)
        self.metadata = {**type(self).metadata, "render_fps": rate}
        self.task = made(task, rest, EnvOptions.names())
        self._spawn = Spawn(self.task, self._options.worlds, self._options.difficulty, config)
        self.pool = self._spawn.pool
        self._options.check_view(link)
        self._connect(link, config)
        tried(self.task, config, self.sensors)
        self.action_space: Any
        self.observation_space: Any
        self.action_space, self.observation_space = task_spaces(self.task, self.sensors)
        self._episode: Episode | None = None
        self._sensed: Observation = NOTHING_SENSED
        self._truth: GroundTruth | None = None
        self._told_last: tuple[Observation, Info] | None = None

    def _connect(self, link: Any, config: RobotConfig) -> None:
        """Make the robot with its link and sensors, and the screen; opens nothing."""
        wire, asked = self._link(link, config), self._options
        step, simulated = self.ticks_per_step * config.period, wire.truth is not None
        self._randomizer = Randomizer(asked.randomization, config, step, simulated=simulated)
        faults = Faults.of(asked.faults)
        self._faulty = FaultyLink(wire, faults) if faults.possible else None
        self._record = EnvRecord(asked.record)
        own = config, asked.factories(self.task), self._record.recorder
        self.robot = Robot(self._faulty or wire, *own)
        self._top = (config.max_linear, config.max_angular)
        mode = None if self._bullets_window(link) else self.render_mode
        self._screen = Screen(config, mode, asked.view)

    def _link(self, link: Any, config: RobotConfig) -> Link:
        """Make the link that the `link` argument names, or return a Link that was given."""
        if not isinstance(link, str | os.PathLike) and hasattr(link, "advance"):
            ready: Link = link
            return ready
        human = self.render_mode == "human"
        return open_link(link, config, window=self._bullets_window(link), realtime=human)

    def _bullets_window(self, link: Any) -> bool:
        """Whether PyBullet shows the robot in its own window."""
        return self.render_mode == "human" and link == "bullet" and display.found()

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
            TaskError, SensorError: where a task or sensor fails, or gives NaN.
        """
        self._halt()
        self._told_last = None
        super().reset(seed=seed)
        if self._faulty is not None:
            self._faulty.seed(self.np_random)
        assignment = self._spawn.draw(self.np_random, {} if options is None else options)
        self._episode = episode = Episode(self.task, assignment)
        start, physics = assignment.start, self._randomizer.draw(self.np_random)
        scene = Scene(start, point_in_world(start, assignment.goal), assignment.world, physics)
        self._record.begin(self.spec, self.task, seed, assignment)
        self.robot.reset(scene, self.np_random)
        self._sensed = self.robot.read().astype(np.float32)
        self._screen.begin(assignment, self.task.goal_tolerance)
        with self._stopping():
            state = self._state(episode, (0.0, 0.0))
            episode.begin(state)
            told = self._told(episode, state)
            self._record.first(self.robot, told[0])
            return told

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Drive for one env step; the class of the id describes spaces, reward and end.

        Args:
            action: (2,), linear and angular, clipped to [-1, 1].

        Returns:
            Observation (numbers,) float32, reward, terminated, truncated and info.

        Raises:
            CommandError: for another shape, NaN or infinity; the wheels are commanded to stop.
            ConfigError: before the first reset.
            LinkError: where the link or the board fails and `on_fault` is "raise".
            TaskError, SensorError: where a task or sensor fails, or gives NaN.
        """
        episode = self._episode
        if episode is None:
            raise ConfigError("step() before reset(): call reset() first")
        try:
            linear, angular = checked(action)
        except CommandError:
            self._halt()
            raise
        try:
            self._drive(linear * self._top[0], angular * self._top[1])
        except LinkError as error:
            if self._told_last is None or self._options.on_fault == "raise":
                raise
            return self._cut_short(error, episode, action)
        episode.steps += 1
        with self._stopping():
            state = self._state(episode, (linear, angular))
            reward, outcome = episode.step(state)
            observation, info = self._told(episode, state)
        over = outcome is not Outcome.GOING
        if over:
            self._halt()
        told = observation, reward, over, False
        self._record.stepped(self.robot, episode.steps, action, told, info["is_success"])
        return observation, reward, over, False, info

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """Stop the robot and close the link where anything inside the block raises."""
        try:
            yield
        except BaseException as error:
            self.robot.deactivate(error)
            raise

    def _halt(self) -> None:
        """Stop the wheels between episodes.

        A link that is lost is closed, and the next reset opens it.
        """
        try:
            self.robot.stop()
        except LinkError as error:
            self.robot.deactivate(error)

    def _cut_short(
        self, error: LinkError, episode: Episode, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, Info]:
        """Truncate the episode because the link failed; the observation is the last one."""
        self.robot.deactivate(error)
        assert self._told_last is not None  # noqa: S101 - for the type checker
        (observation, info), self._told_last = self._told_last, None
        why = {"is_success": 0.0, "fault": float(fault_code(error)), "fault_reason": str(error)}
        self._record.stepped(self.robot, episode.steps + 1, action, (observation, 0.0, False, True))
        return observation, 0.0, False, True, info | self._randomizer.info() | why

    def _drive(self, linear: float, angular: float) -> None:
        """Drive towards a twist [m/s, rad/s] for one env step, then read the sensors."""
        for _ in range(self.ticks_per_step):
            self.robot.drive(linear, angular)
        self._sensed = self.robot.read().astype(np.float32)

    def _state(self, episode: Episode, action: tuple[float, float]) -> State:
        """The State that the task is given."""
        self._truth = self.robot.link.truth
        contact = self._truth is not None and self._truth.contact
        ticks = self.ticks_per_step
        return state_of(self.robot, episode, action, self._sensed, ticks, contact=contact)

    def _told(self, episode: Episode, state: State) -> tuple[Observation, Info]:
        """Observation and info after a reset or step; also updates the screen."""
        self._screen.show(state, self._truth, newest_scan(self.robot.sensors))
        numbers = observed(episode, state, self.task)
        info = info_of(episode, state, self._truth) | self._randomizer.info()
        if self._faulty is not None or self._truth is None:
            info["fault"] = 0.0
        self.robot.tell(info)
        told = np.concatenate([numbers, state.sensed]), info
        self._told_last = told[0].copy(), info.copy()  # a caller may change its own
        return told

    @property
    def sensors(self) -> Sequence[Sensor]:
        """The robot's sensors, in the order of their numbers in the observation."""
        return self.robot.sensors

    @property
    def episode(self) -> Episode:
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
            RenderError: before the first reset.
        """
        if self.render_mode != "rgb_array":
            return None
        if not self.robot.active:
            raise RenderError("there is nothing to see before reset(): call it first")
        return self._screen.picture(self.robot.link)

    def close(self) -> None:
        """Stop the wheels, close link, sensors and window; idempotent."""
        self._told_last = None
        try:
            self.robot.close()
        finally:
            self._screen.close()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have a robot of their own and must be reset first."""
        return self.__dict__ | {"_episode": None, "_told_last": None}

    def __copy__(self) -> Self:
        """Every copy is a deep one, because two environments can't share a robot."""
        return copy.deepcopy(self)

    def __del__(self, is_finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        if is_finalizing():  # wheels have been stopped at exit, and modules are partly gone
            return
        if getattr(self, "robot", None) is not None and hasattr(self, "_screen"):
            with contextlib.suppress(AcsarError):
                self.close()

"""The Gymnasium VectorEnv: thousands of planar robots with one task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from acsar_gym.config import whole_ratio
from acsar_gym.config.fleet import FleetSource, check_equal, make_fleet
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.links.faults import Faults
from acsar_gym.sensors import LIDAR
from acsar_gym.tasks.actions import read_actions
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.factory import make_task
from acsar_gym.tasks.options import check_count, check_reset_options, read_step_limit
from acsar_gym.tasks.spec import PlainSpec, task_spaces
from acsar_gym.tasks.task import Task
from acsar_gym.vector.batch import Batch
from acsar_gym.vector.options import (
    MAX_ROBOTS,
    BatchOptions,
    ResetOptions,
    check_seeds,
    read_reset_options,
)
from acsar_gym.vector.screen import BatchScreen, Image, check_render_mode
from acsar_gym.vector.threads import Threads, choose_threads
from acsar_gym.worlds.search import footprint_radius

MASK_OPTION = "reset_mask"
Array = NDArray[Any]
Info = dict[str, Any]


class RobotVectorEnv(PlainSpec, VectorEnv[Array, Array, Array]):
    """Many planar robots with one task.

    The classes of the registered ids are in `acsar_gym.envs`. Spaces, reward, end and info are
    those of the single env, one row a robot. So are commands, latency, motors, tyres, encoders,
    odometry, LiDAR and worlds: with the same seed and actions a robot does what `link="planar"`
    does, to 1e-9. The task has to be compiled, see `acsar_gym.Task`.

    Arguments besides those of the single env:

    - `num_envs`: Number of robots.
    - `max_episode_steps`: Time limit. Registration gives that of the id, None or -1 is none.
    - `autoreset_mode`: An AutoresetMode or its value, "NextStep" (default), "SameStep", "Disabled".
    - `render_mode`: "rgb_array": `render()` returns a picture for each robot, of which the first 16
      are drawn, for `gymnasium.wrappers.vector.RecordVideo`, which tiles them.
    - `threads`: Largest number of cores to use. None uses all if there is enough to do. Results
      don't depend on it.

    ## Fleets

    With `robot=["acsar", "jackal", "husky"]`, a list of what `RobotConfig.of` takes, or a range of
    drawn robots such as "drawn:train" (see `acsar_gym.config.drawn`), robot i of the batch is
    always number i % (robots of the fleet). Each is what a single env of that robot would be, with
    worlds that fit its footprint. `fleet` has the configurations, and `config` the first one. All
    must have the same timing of wire and board, and as many rays if these are observed.

    All worlds, at most 10,000 for each size of footprint, are made when the batch is. Seeds:
    `reset(seed=s)` seeds robot i with s + i, or a list has one seed for each. Every robot has its
    own generator, the same as the single env's.

    ## Options of a reset

    The options of the single env, each as an array with a row for each robot or as one value for
    all. NaN leaves a robot without the option. Options hold for these robots in all episodes that
    follow by autoreset, until their next `reset`. A reset without options removes them.
    `set_options` sets them for later episodes without ending any, for instance for a curriculum.

    - `reset_mask`: (num_envs,) booleans, the robots to reset. Without it all are reset.
    - `world`: (num_envs,) numbers of worlds. `goal`: (num_envs, 2), in the odometry frame [m].
    - `difficulty`: (num_envs, 2), low and high: worlds are drawn among those of the batch whose
      difficulty lies in that range. A batch made with `difficulty=None` has all from 0 to 1.

    ## Info

    That of the single env, an array with a row for each robot under each key.

    After Ctrl-C in `reset` or `step` all robots must be reset. With a seed, they then behave like
    those of a new batch.

    Example:
        >>> import gymnasium
        >>> import acsar_gym
        >>> batch = gymnasium.make_vec(
        ...     "acsar_gym/PointGoal-v0", 8, vectorization_mode="vector_entry_point"
        ... )
        >>> observations, infos = batch.reset(seed=0)
        >>> observations.shape
        (8, 7)
        >>> batch.close()
    """

    closed = True  # until it is made: Gymnasium before 1.3 closes what raised an error in __init__
    metadata: dict[str, Any] = {  # noqa: RUF012 - as VectorEnv declares it
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: Task | type[Task] | str,
        num_envs: int = 1,
        robot: FleetSource = None,
        **options: Any,
    ) -> None:
        """Make the batch, and all its worlds.

        Args:
            task: A task, its class, or "module:Class".
            num_envs: Number of robots.
            robot: Configuration of every robot, see `RobotConfig.of`, or a fleet, see the class.
            **options: Options of the batch, see the class, and of the task.

        Raises:
            ConfigError, WorldError: Options are unknown, or values out of range.
        """
        chosen, task_options = BatchOptions.split(options)

        # What the single env has and a batch can't have.
        has_faults = Faults.of(chosen.faults).possible
        for name, is_refused in (("link", chosen.link != "planar"), ("faults", has_faults)):
            if is_refused:
                value = show_value(getattr(chosen, name))
                raise ConfigError(
                    f"{name} = {value}: a batch has planar robots without faults: make_vec with "
                    "vectorization_mode='sync' or 'async'"
                )
        self.render_mode = check_render_mode(chosen.render_mode)
        self.num_envs = check_count("num_envs", num_envs, MAX_ROBOTS)

        # Robots and their rates.
        fleet = make_fleet(robot, self.num_envs)
        self.fleet = fleet.robots
        self.config = fleet.robots[0]
        for config in self.fleet:
            config.check_simulated()
        rate = chosen.policy_rate
        control_rate = self.config.control_rate
        self.ticks_per_step = whole_ratio("control_rate", control_rate, "policy_rate", rate)
        self.autoreset_mode = chosen.autoreset_mode
        modes = {"autoreset_mode": self.autoreset_mode, "render_fps": rate}
        self.metadata = type(self).metadata | modes

        # The task, and for each size of footprint its worlds.
        self.task = make_task(task, task_options, BatchOptions.names())
        by_radius: dict[float, Spawn] = {}
        for config in self.fleet:
            radius = footprint_radius(config)
            if radius not in by_radius:
                by_radius[radius] = Spawn(self.task, chosen.worlds, chosen.difficulty, config)
        spawns = [by_radius[footprint_radius(config)] for config in self.fleet]
        self._spawn = spawns[0]
        self.pool = self._spawn.pool

        # Sensors, and the arrays of all robots.
        sensors = (*self.task.sensors, *chosen.sensors)
        for place in range(1, len(self.fleet) if LIDAR in sensors else 0):
            check_equal(fleet, place, "lidar.rays")  # each is a column of the observation
        limit = read_step_limit(chosen.max_episode_steps)
        self.batch = Batch(
            self.num_envs,
            self.fleet,
            self.task,
            spawns=spawns,
            sensors=sensors,
            ticks=self.ticks_per_step,
            max_steps=math.inf if limit is None else float(limit),
            randomization=chosen.randomization,
        )
        self.sensors = self.batch.sensors

        # Spaces.
        action_space, observation_space = task_spaces(self.task, self.sensors)
        self.single_action_space = action_space
        self.single_observation_space = observation_space
        self.action_space = batch_space(action_space, self.num_envs)
        self.observation_space = batch_space(observation_space, self.num_envs)

        self._screen: BatchScreen | None = None
        if self.render_mode is not None:
            self._screen = BatchScreen(self.fleet, self.num_envs, self.task.goal_tolerance)
        self._threads = Threads(choose_threads(chosen.threads, self.num_envs))
        self._done = np.zeros(self.num_envs, np.bool_)
        self._masks: tuple[str, ...] = ()
        self._is_intact = True
        """False during a call. It stays False if the call was interrupted."""
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Array, Info]:
        """Begin new episodes for all robots, or those in `options["reset_mask"]`.

        Args:
            seed: Seed s seeds robot i with s + i. A list has a seed for each robot. None keeps the
                generators.
            options: Options of these robots until they are reset again, see the class.

        Returns:
            Observations (num_envs, numbers) and info.

        Raises:
            ConfigError, WorldError: Options are unknown, or values are malformed.
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        self._check_open("reset")
        mask, fields = self._read_options(options)
        if not (mask.all() or (self.batch.seeded and self._is_intact)):
            raise ConfigError(
                "reset_mask: the first reset, and the next one after an interrupt, must be of all "
                "robots"
            )
        seeds = check_seeds(seed, self.num_envs)

        # An interrupted call leaves robots between two states.
        self._is_intact = False
        self.batch.seed(seeds, mask)
        self.batch.set_reset_options(fields, mask)
        self.batch.reset(mask, self._threads.share)
        # Not in place: the last info may hold this array as a mask.
        self._done = self._done & ~mask
        self._is_intact = True
        return self.batch.tables.observations.copy(), self._info(mask)

    def set_options(self, options: Mapping[str, Any]) -> None:
        """Set options as in `reset`, for later episodes. Running episodes go on.

        Args:
            options: Options of the robots, see the class.

        Raises:
            ConfigError, WorldError: Options are unknown, or values are malformed.
        """
        mask, fields = self._read_options(options)
        self.batch.set_reset_options(fields, mask)

    def _read_options(self, options: Mapping[str, Any] | None) -> tuple[Array, ResetOptions]:
        """Which robots a reset's options are for, and the options as fields of the robots.

        Waits for the threads of an interrupted call, because the state is written next.
        """
        self._threads.wait()
        names = [name for name in self._spawn.options if name != "path"]  # a single env's
        options = check_reset_options(options or {}, (MASK_OPTION, *names))
        chosen = {name: value for name, value in options.items() if name != MASK_OPTION}
        mask = options.get(MASK_OPTION)
        mask = np.ones(self.num_envs, np.bool_) if mask is None else np.array(mask, order="C")
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ConfigError(f"reset_mask: must be a boolean array of shape ({self.num_envs},)")
        return mask, read_reset_options(self._spawn, chosen, self.num_envs)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Do one env step of every robot.

        Args:
            actions: (num_envs, 2), linear and angular, clipped to [-1, 1].

        Returns:
            Observations (num_envs, numbers), rewards, terminated, truncated (num_envs,), info.

        Raises:
            CommandError: An action has another shape, is NaN or infinite, or isn't numbers. The
                message names the first bad env.
            ConfigError: There was no reset since an interrupted call, the batch is closed, or an
                env has ended.
            ConfigError: The task fails, or returns NaN.
            AcsarError: A sensor fails, or returns NaN.
        """
        self._check_open("step")
        batch = self.batch
        tables = batch.tables
        actions = read_actions(actions, (self.num_envs, 2))
        if not batch.seeded:
            raise ConfigError("step() before reset(): call reset() first")
        if not self._is_intact:
            raise ConfigError("step() after an interrupted call: reset() all robots first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            raise ConfigError(
                f"env {int(self._done.argmax())} has ended: reset it with options['reset_mask']"
            )

        self._is_intact = False
        tables.actions[:] = actions

        # With NEXT_STEP a robot that has ended starts an episode instead of driving.
        tables.begins[:] = self.autoreset_mode is AutoresetMode.NEXT_STEP and self._done
        batch.step(self._threads.share)

        # Loops write into the same arrays again, and callers keep what they got.
        rewards = tables.rewards.copy()
        terminated = tables.terminated.copy()
        truncated = tables.truncated.copy()
        self._done = terminated | truncated

        info: Info = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            # The reset overwrites the last observations and info of these episodes.
            info = self._final_info(self._done)
            batch.reset(self._done, self._threads.share)
        self._is_intact = True
        info |= self._info(np.ones(self.num_envs, np.bool_))
        return tables.observations.copy(), rewards, terminated, truncated, info

    def _check_open(self, method: str) -> None:
        """Raise ConfigError if the batch is closed."""
        if self.closed:
            raise ConfigError(f"{method}() of a closed batch: make a new one")

    def render(self) -> tuple[Image, ...] | None:
        """Return a picture for each robot, (height, width, 3) uint8, or None without `render_mode`.

        The first 16 robots are drawn from above, the pictures of others are empty.

        Raises:
            ConfigError: There was no reset.
        """
        if self._screen is None:
            return None
        if not self.batch.seeded:
            raise ConfigError("there is nothing to see before reset(): call it first")
        return self._screen.pictures(self.batch)

    def _final_info(self, done: Array) -> Info:
        """The keys that Gymnasium asks for where an episode ends and is reset in the same step."""
        # Robots that go on have no final observation: the array holds objects.
        final = np.full(self.num_envs, None, object)
        for index in np.flatnonzero(done):
            final[index] = self.batch.tables.observations[index].copy()
        returns, lengths = self.batch.read("total_reward", "steps")
        info = self._info(done)
        info |= {"episode_return": returns, "_episode_return": done}
        info |= {"episode_length": lengths, "_episode_length": done}
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done}

    def _info(self, mask: Array) -> Info:
        """The batch's info, and under "_key" the mask of the robots that it is valid for."""
        info = self.batch.info()
        if len(self._masks) != len(info):
            self._masks = tuple(f"_{name}" for name in info)
        return info | dict.fromkeys(self._masks, mask)

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._threads.close()

"""Episodes of a policy, one after the other, or as a batch with the same results."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Generator, Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors.suite import BUILT_IN, is_polled
from acsar_gym.tasks.episode import Assignment, RunningEpisode
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import is_compiled, says_shortest_path
from acsar_gym.tools.evaluation.episode import (
    TRACK_KEYS,
    Drive,
    Episode,
    Resets,
    known_pose,
    measure_episode,
)
from acsar_gym.tools.policies import FilePolicy, Policy
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import World

MAX_LATE_SHARE = 0.01
"""Default of the largest share of late ticks in a valid episode."""
MIN_EPISODES = 16
"""Fewer episodes are driven one by one: making a batch takes longer than it saves."""
MAX_BATCH = 128
"""Most robots of a batch. A robot whose episode has ended starts the next one."""
MAX_BATCH_WORLDS = 10_000
"""Most worlds that a batch takes."""
SINGLE_OPTIONS = ("faults", "lidar", "on_fault", "record", "render_mode", "view")
"""Options of an env that a batch doesn't have: their episodes are driven one by one."""


def run_episodes(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    count: int,
    seed: int,
    *,
    in_order: bool = False,
    late_share: float = MAX_LATE_SHARE,
    **options: Any,
) -> Generator[Episode, None, None]:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and yield the result of each in order.

    Many episodes of planar robots are driven as a batch, with the same results, if the policy has
    no memory; see `can_batch`. A fault, or too many late ticks, make an episode invalid. After a
    fault, the next reset connects again.

    Args:
        env: Env of this package, wrapped or not.
        policy: Maps observations to actions. `reset()`, if it has that method, starts an episode,
            and `bind` gets the `PolicyContext` of the env, unless `make_env` gave it that.
        count: Number of episodes.
        seed: Seed of the first reset.
        in_order: Use the env's worlds one after the other, instead of random ones.
        late_share: Largest share of late ticks in a valid episode, 0 to 1.
        **options: Options of every reset.

    Yields:
        The result of each episode.

    Raises:
        ConfigError: There are fewer worlds than episodes with `in_order`, or `late_share` or
            `env` can't be used.
        LinkError: The robot can't be reached.
        EmergencyStopError: Its emergency stop was used.
    """
    resets = plan_resets(env, range(seed, seed + count), in_order=in_order, options=options)
    return run_resets(env, policy, resets, late_share)


def plan_resets(
    env: gymnasium.Env[Any, Any],
    seeds: range,
    *,
    in_order: bool = False,
    options: Mapping[str, Any] = {},
) -> list[tuple[int, dict[str, Any]]]:
    """Return seed and options of each episode's reset; arguments as for `run_episodes`."""
    pool: Any = getattr(env.unwrapped, "pool", None)
    worlds = 0 if pool is None else len(pool)
    if in_order and worlds < len(seeds):
        raise ConfigError(
            f"{len(seeds)} episodes in order need as many worlds, but there are {worlds}"
        )
    return [
        (seed, {**options, **({"world": pool.key(place)} if in_order else {})})
        for place, seed in enumerate(seeds)
    ]


def check_late_share(late_share: float) -> None:
    """Raise ConfigError unless it is a share of ticks."""
    if not 0.0 <= late_share <= 1.0:
        raise ConfigError(f"late_share = {late_share!r}: must be a share, 0 to 1")


def run_resets(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    resets: Resets,
    late_share: float = MAX_LATE_SHARE,
) -> Generator[Episode, None, None]:
    """Run episodes as `run_episodes`, with these seeds and options of their resets."""
    check_late_share(late_share)
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))

    if can_batch(env, policy, resets):
        drives = _drive_batch(env, inner, policy, resets)
    else:
        drives = (_drive_env(env, inner, policy, *reset) for reset in resets)
    for drive in drives:
        yield measure_episode(inner, drive, late_share)


def _drive_env(
    env: gymnasium.Env[Any, Any],
    inner: RobotEnv,
    policy: Policy,
    seed: int,
    options: Mapping[str, Any],
) -> Drive:
    """Drive one episode, and stop the robot."""
    robot = inner.robot
    robot.link.metered = True
    observation, info = env.reset(seed=seed, options=dict(options))
    if (reset := getattr(policy, "reset", None)) is not None:
        reset()
    rows = [[info.get(key, math.nan) for key in TRACK_KEYS]]
    way = inner.episode.shortest_path(known_pose(rows[0]))  # measured later: a robot doesn't wait

    total_reward = 0.0
    is_done = False
    while not is_done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rows.append([info.get(key, math.nan) for key in TRACK_KEYS])
        total_reward += float(reward)
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise EmergencyStopError
        is_done = terminated or truncated
    return Drive(
        seed=seed,
        episode=inner.episode,
        track=np.array(rows, np.float64),
        info=info,
        way=way,
        total_reward=total_reward,
        started=robot.wire.start,
        ended=robot.wire.stamp,
        energy=robot.link.work,
        timing=robot.timing,
    )


def can_batch(env: gymnasium.Env[Any, Any], policy: Policy, resets: Resets) -> bool:
    """Whether these episodes can be driven as a batch, and are worth it."""
    spec = env.spec
    inner = env.unwrapped
    if spec is None or not isinstance(inner, RobotEnv) or len(resets) < MIN_EPISODES:
        return False

    task = inner.task
    is_planar = spec.kwargs.get("link") == "planar" and spec.vector_entry_point is not None
    has_no_memory = getattr(policy, "act_many", None) is not None
    has_shared_options = all(spec.kwargs.get(name) is None for name in SINGLE_OPTIONS)
    knows_ways = not says_shortest_path(task) or type(task).shortest_path is GoalTask.shortest_path
    own_sensors = [sensor for sensor in inner.sensors if sensor.name not in BUILT_IN]
    return (
        is_planar
        and has_no_memory
        and has_shared_options
        and knows_ways
        and is_compiled(task)
        and not any(is_polled(sensor) or sensor.needs for sensor in own_sensors)
        and not spec.additional_wrappers
        and (inner.pool is None or inner.pool.numbers is not None)  # of several sets: names
        and all(options.keys() <= {"world"} for _, options in resets)
        and not any(isinstance(options.get("world"), World) for _, options in resets)
        and len(_name_worlds(inner, resets) or inner.pool or ()) <= MAX_BATCH_WORLDS
    )


def _name_worlds(env: RobotEnv, resets: Resets) -> list[int] | None:
    """Return the numbers of the worlds that are named; None if any of the env's may be drawn."""
    if env.pool is None or not all(options for _, options in resets):
        return None
    return sorted({int(options["world"]) for _, options in resets})


def _drive_batch(
    env: gymnasium.Env[Any, Any], inner: RobotEnv, policy: Any, resets: Resets
) -> Iterator[Drive]:
    """Drive episodes as a batch, and yield them in order."""
    spec = copy.copy(env.spec)
    assert spec is not None  # noqa: S101 - `can_batch` has seen it
    spec.kwargs = {**spec.kwargs, "autoreset_mode": AutoresetMode.NEXT_STEP}
    numbers = _name_worlds(inner, resets)
    if numbers is not None and inner.pool is not None:
        worlds = [inner.pool[number] for number in numbers]
        spec.kwargs |= {"worlds": worlds, "difficulty": None}
    robots = min(len(resets), MAX_BATCH)
    batch = gymnasium.make_vec(spec, robots, vectorization_mode="vector_entry_point").unwrapped
    assert isinstance(batch, RobotVectorEnv)  # noqa: S101 - no other class is registered
    with contextlib.closing(batch):
        yield from BatchDriver(inner, batch, policy, resets, numbers).drives()


class BatchDriver:
    """The robots of a batch, which drive episodes; a free robot starts the next one.

    Args:
        env: Env that would drive the episodes one by one.
        batch: Batch of robots.
        policy: A policy without memory.
        resets: Seeds and options of the episodes.
        numbers: Numbers of the batch's worlds in `env`; None if they are the same.
    """

    def __init__(
        self,
        env: RobotEnv,
        batch: RobotVectorEnv,
        policy: Any,
        resets: Resets,
        numbers: list[int] | None,
    ) -> None:
        batch.batch.measure_work()
        self._env = env
        self._batch = batch
        self._policy = policy
        self._resets = resets
        self._numbers = numbers
        self._started = 0
        """Number of episodes that have started."""
        self._places = np.full(batch.num_envs, -1)
        """Place of each robot's episode among the resets; -1 for none."""
        self._tracks: list[list[NDArray[np.float64]]] = [[] for _ in range(batch.num_envs)]
        self._rewards = np.zeros(batch.num_envs)
        self._first_ticks = np.zeros(batch.num_envs, np.int64)
        """Ticks of each robot's reset."""

    def drives(self) -> Iterator[Drive]:
        """Drive, and yield each episode after all before it have ended."""
        waiting: dict[int, Drive] = {}
        next_place = 0
        observations = self._start(np.ones(self._batch.num_envs, np.bool_))
        while next_place < len(self._resets):
            is_driving = self._places >= 0
            actions = np.zeros((self._batch.num_envs, 2), np.float32)
            actions[is_driving] = self._policy.act_many(observations[is_driving])
            observations, rewards, terminated, truncated, info = self._batch.step(actions)
            self._rewards += rewards
            self._note(info, is_driving)

            has_ended = is_driving & (terminated | truncated)
            for robot in np.flatnonzero(has_ended).tolist():
                waiting[int(self._places[robot])] = self._finish(robot, info)
            self._places[has_ended] = -1
            while next_place in waiting:
                yield waiting.pop(next_place)
                next_place += 1
            if has_ended.any() and self._started < len(self._resets):
                observations = self._start(has_ended)

    def _start(self, is_free: NDArray[np.bool_]) -> NDArray[Any]:
        """Start the next episodes with free robots; returns the observations of all robots."""
        robots = np.flatnonzero(is_free)[: len(self._resets) - self._started].tolist()
        mask = np.zeros(self._batch.num_envs, np.bool_)
        mask[robots] = True
        seeds: list[int | None] = [None] * self._batch.num_envs
        worlds = np.full(self._batch.num_envs, math.nan)
        for robot in robots:
            seed, options = self._resets[self._started]
            seeds[robot] = seed
            if "world" in options:
                number = int(options["world"])
                worlds[robot] = self._numbers.index(number) if self._numbers else number
            self._places[robot] = self._started
            self._tracks[robot] = []
            self._started += 1

        options = {"reset_mask": mask}
        if not np.isnan(worlds).all():
            options["world"] = worlds
        observations, info = self._batch.reset(seed=seeds, options=options)
        self._rewards[mask] = 0.0
        self._note(info, mask)
        (loops,) = self._batch.batch.read("loops")
        config = self._env.robot.config
        self._first_ticks[mask] = loops[mask] / round(config.firmware.loop_rate * config.period)
        return observations

    def _note(self, info: Mapping[str, Any], mask: NDArray[np.bool_]) -> None:
        """Add a row to the tracks of these robots."""
        unknown = np.full(self._batch.num_envs, math.nan)
        rows = np.column_stack([info.get(key, unknown) for key in TRACK_KEYS])
        for robot in np.flatnonzero(mask):
            self._tracks[robot].append(rows[robot])

    def _finish(self, robot: int, batch_info: Mapping[str, Any]) -> Drive:
        """Return the episode of a robot that has ended it."""
        info = {key: row[robot] for key, row in batch_info.items() if not key.startswith("_")}
        names = ("start_x", "start_y", "start_theta", "goal_x", "goal_y", "work")
        numbers = self._batch.batch.read(*names)[:, robot].tolist()
        x, y, theta, goal_x, goal_y, work = numbers
        world = None
        key = -1
        if self._env.pool is not None:
            key = int(info["world"])
            key = self._numbers[key] if self._numbers else key
            world = self._env.pool[key]
            info["world"] = key
        assignment = Assignment((goal_x, goal_y), world, world_key=key, start=(x, y, theta))
        episode = RunningEpisode(self._env.task, assignment)
        episode.state = State(goal=assignment.goal)

        # The clock of a link adds up its periods, which rounds.
        track = np.array(self._tracks[robot])
        first_tick = int(self._first_ticks[robot])
        ticks = (len(track) - 1) * self._env.ticks_per_step
        period = self._env.robot.config.period
        clock = np.cumsum(np.full(first_tick + ticks, period))
        return Drive(
            seed=self._resets[int(self._places[robot])][0],
            episode=episode,
            track=track,
            info=info,
            way=episode.shortest_path(known_pose(track[0])),
            total_reward=float(self._rewards[robot]),
            started=float(clock[first_tick]) - period,
            ended=float(clock[-1]),
            energy=work,
        )

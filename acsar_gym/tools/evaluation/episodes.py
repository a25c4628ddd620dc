"""Episodes of a policy, one after the other, or as a batch with the same results."""

from __future__ import annotations

import copy
import math
from collections.abc import Generator, Iterator
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
    Episode,
    Resets,
    known_pose,
    measure_episode,
)
from acsar_gym.tools.policies import FilePolicy, Policy
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import World

MAX_LATE_SHARE = 0.01  # largest share of late ticks in a valid episode
MIN_EPISODES = 16  # fewer episodes are driven one by one: making a batch takes longer than it saves
MAX_BATCH = 128  # robots of a batch, at most; one that has ended begins the next episode
MAX_BATCH_WORLDS = 10_000  # worlds that a batch takes, at most
SINGLE_OPTIONS = ("faults", "lidar", "on_fault", "record", "render_mode", "view")
"""Options of an env whose episodes are driven one by one."""


def run_episodes(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    count: int,
    seed: int,
    *,
    in_order: bool = False,
    skip: int = 0,
    late_share: float = MAX_LATE_SHARE,
    **options: Any,
) -> Generator[Episode, None, None]:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and yield the result of each in order.

    Many episodes of planar robots are driven as a batch, with the same results, where the policy
    has no memory; see `can_batch`. A fault, or too many late ticks, make an episode not valid; the
    next reset connects again.

    Args:
        env: an env of this package, wrapped or not.
        policy: maps observations to actions; `reset()`, where it has that method, begins an episode
            of it, and `bind` gets the `PolicyContext` of the env, unless `make_env` gave it that.
        count: number of episodes.
        seed: seed of the first reset.
        in_order: use the env's worlds one after the other, instead of random ones.
        skip: with `in_order`, how many of the worlds other calls use before this one.
        late_share: largest share of late ticks in a valid episode, 0 to 1.
        **options: options of every reset.

    Yields:
        The result of each episode.

    Raises:
        ConfigError: there are fewer worlds than episodes with `in_order`, or `late_share` or
            `env` can't be used.
        LinkError: the robot can't be reached.
        EmergencyStopError: its emergency stop was used.
    """
    pool: Any = getattr(env.unwrapped, "pool", None)
    worlds = 0 if pool is None else len(pool)
    if in_order and worlds < skip + count:
        raise ConfigError(
            f"{skip + count} episodes in order need as many worlds, but there are {worlds}"
        )
    resets = [
        (seed + number, options | ({"world": pool.key(skip + number)} if in_order else {}))
        for number in range(count)
    ]
    return run_resets(env, policy, resets, late_share)


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
    """As `run_episodes`, with these seeds and options."""
    check_late_share(late_share)
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))
    if can_batch(env, policy, resets):
        yield from run_batch(env, policy, resets)
        return
    for seed, options in resets:
        yield _run_episode(env, inner, policy, seed, dict(options), late_share)


def _run_episode(
    env: gymnasium.Env[Any, Any],
    inner: RobotEnv,
    policy: Policy,
    seed: int,
    options: dict[str, Any],
    late_share: float,
) -> Episode:
    """Run one episode, stop the robot, and compute the result."""
    robot = inner.robot
    robot.link.metered = True
    observation, info = env.reset(seed=seed, options=options)
    if (begin := getattr(policy, "reset", None)) is not None:
        begin()
    rows, rewards, done = [[info.get(key, math.nan) for key in TRACK_KEYS]], 0.0, False
    way = inner.episode.shortest_path(known_pose(rows[0]))  # measured later: a robot doesn't wait
    while not done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rows.append([info.get(key, math.nan) for key in TRACK_KEYS])
        rewards += float(reward)
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise EmergencyStopError
        done = terminated or truncated
    timing = robot.timing
    fault = info.get("fault_reason", "")
    late = timing.lateness.late_share if timing else 0.0
    length, track = len(rows) - 1, np.array(rows, np.float64)
    return Episode(
        seed=seed,
        fault=fault,
        valid=not fault and late <= late_share,
        started=robot.wire.start,
        ended=robot.wire.stamp,
        length=length,
        ticks=length * inner.ticks_per_step,
        late_ticks=timing.lateness.late_ticks if timing else 0,
        episode_return=rewards,
        energy=robot.link.work,
        timing=timing,
        **measure_episode(inner, inner.episode, track, info, way),
    )


def can_batch(env: gymnasium.Env[Any, Any], policy: Policy, resets: Resets) -> bool:
    """Whether these episodes can be driven as a batch, and are worth it."""
    spec, inner = env.spec, env.unwrapped
    if spec is None or not isinstance(inner, RobotEnv) or len(resets) < MIN_EPISODES:
        return False
    kwargs, task = spec.kwargs, inner.task
    own_sensors = [sensor for sensor in inner.sensors if sensor.name not in BUILT_IN]
    ways_known = not says_shortest_path(task) or type(task).shortest_path is GoalTask.shortest_path
    return (
        kwargs.get("link") == "planar"
        and getattr(policy, "act_many", None) is not None
        and spec.vector_entry_point is not None
        and is_compiled(task)
        and not any(is_polled(sensor) or sensor.needs for sensor in own_sensors)
        and not spec.additional_wrappers
        and all(kwargs.get(name) is None for name in SINGLE_OPTIONS)
        and ways_known
        and not (inner.pool is not None and inner.pool.numbers is None)  # worlds have names
        and all(set(options) <= {"world"} for _, options in resets)
        and not any(isinstance(options.get("world"), World) for _, options in resets)
        and len(_list_worlds(inner, resets)) <= MAX_BATCH_WORLDS
    )


def _list_worlds(env: RobotEnv, resets: Resets) -> range | list[int]:
    """Numbers of the worlds that are driven in: those that are named, or all."""
    if env.pool is None or env.pool.numbers is None:
        return range(0)
    named = {int(options["world"]) for _, options in resets if "world" in options}
    return sorted(named) if all(options for _, options in resets) else env.pool.numbers


def run_batch(env: gymnasium.Env[Any, Any], policy: Any, resets: Resets) -> Iterator[Episode]:
    """Drive episodes as a batch, and yield them in order."""
    inner: Any = env.unwrapped
    numbers = _list_worlds(inner, resets)
    batch = _make_batch(env, inner, numbers, min(len(resets), MAX_BATCH))
    try:
        yield from _BatchRun(inner, batch, policy, resets, numbers).episodes()
    finally:
        batch.close()


def _make_batch(
    env: gymnasium.Env[Any, Any], inner: RobotEnv, numbers: range | list[int], robots: int
) -> RobotVectorEnv:
    """Make the batch of an env, with these worlds of it alone."""
    spec = copy.copy(env.spec)
    assert spec is not None  # noqa: S101 - `can_batch` has seen it
    spec.kwargs = {**spec.kwargs, "autoreset_mode": AutoresetMode.NEXT_STEP}
    if inner.pool is not None and numbers != inner.pool.numbers:
        spec.kwargs |= {"worlds": [inner.pool[number] for number in numbers], "difficulty": None}
    batch = gymnasium.make_vec(spec, robots, vectorization_mode="vector_entry_point").unwrapped
    assert isinstance(batch, RobotVectorEnv)  # noqa: S101 - no other class is registered
    batch.batch.measure_work()
    return batch


class _BatchRun:
    """The episodes that the robots of a batch are driving."""

    def __init__(
        self,
        env: RobotEnv,
        batch: RobotVectorEnv,
        policy: Any,
        resets: Resets,
        numbers: range | list[int],
    ) -> None:
        self._env, self._batch, self._policy = env, batch, policy
        self._resets, self._numbers = resets, numbers
        robots = batch.num_envs
        self._which = np.full(robots, -1)
        """Number of the episode that each robot drives; -1 for none."""
        self._begun = 0
        self._steps = np.zeros(robots, np.int64)
        self._returns = np.zeros(robots)
        self._tracks = np.zeros((robots, 256, len(TRACK_KEYS)))
        """TRACK_KEYS of each robot at the reset and after every step."""
        self._first_ticks = np.zeros(robots, np.int64)
        """Ticks of each robot's reset."""

    def episodes(self) -> Iterator[Episode]:
        """Drive, and yield each episode once all before it have ended."""
        batch, waiting, next_number = self._batch, dict[int, Episode](), 0
        observations = self._begin(np.ones(batch.num_envs, np.bool_))
        while next_number < len(self._resets):
            actions = np.zeros((batch.num_envs, 2), np.float32)
            driving = self._which >= 0
            actions[driving] = self._policy.act_many(observations[driving])
            observations, rewards, terminated, truncated, info = batch.step(actions)
            self._returns += rewards
            self._steps += 1
            self._note(info, driving)
            ended = driving & (terminated | truncated)
            for robot in np.flatnonzero(ended):
                waiting[int(self._which[robot])] = self._finish(int(robot), info)
            self._which[ended] = -1
            while next_number in waiting:
                yield waiting.pop(next_number)
                next_number += 1
            if ended.any() and self._begun < len(self._resets):
                observations = self._begin(ended)

    def _begin(self, free: NDArray[np.bool_]) -> NDArray[Any]:
        """Begin the next episodes with free robots, as far as there are some."""
        robots = np.flatnonzero(free)[: len(self._resets) - self._begun]
        mask = np.zeros(self._batch.num_envs, np.bool_)
        mask[robots] = True
        seeds: list[int | None] = [None] * self._batch.num_envs
        worlds = np.full(self._batch.num_envs, math.nan)
        for robot in robots:
            seed, reset = self._resets[self._begun]
            self._which[robot] = self._begun
            self._begun += 1
            seeds[robot] = seed
            if "world" in reset:
                worlds[robot] = self._place(int(reset["world"]))
        options: dict[str, Any] = {"reset_mask": mask}
        if not np.isnan(worlds).all():
            options["world"] = worlds
        observations, info = self._batch.reset(seed=seeds, options=options)
        self._steps[mask], self._returns[mask] = 0, 0.0
        self._note(info, mask)
        (loops,) = self._batch.batch.read("loops")
        config = self._env.robot.config
        per_tick = round(config.firmware.loop_rate * config.period)
        self._first_ticks[mask] = loops[mask] / per_tick
        return observations

    def _place(self, number: int) -> int:
        """The batch's number of a world."""
        numbers = self._numbers
        return number if isinstance(numbers, range) else numbers.index(number)

    def _note(self, info: dict[str, Any], mask: NDArray[np.bool_]) -> None:
        """Note the row of each robot's track."""
        if self._steps.max() >= self._tracks.shape[1]:
            self._tracks = np.concatenate([self._tracks, np.zeros_like(self._tracks)], axis=1)
        robots = np.flatnonzero(mask)
        for column, key in enumerate(TRACK_KEYS):
            values = info[key][robots] if key in info else math.nan
            self._tracks[robots, self._steps[robots], column] = values

    def _finish(self, robot: int, infos: dict[str, Any]) -> Episode:
        """Compute the result of a robot's episode."""
        env, batch = self._env, self._batch.batch
        info = {key: values[robot] for key, values in infos.items() if not key.startswith("_")}
        names = ("start_x", "start_y", "start_theta", "goal_x", "goal_y", "work")
        x, y, theta, goal_x, goal_y, work = batch.read(*names)[:, robot].tolist()
        world, number = None, -1
        if env.pool is not None:
            number = int(info["world"])
            number = number if isinstance(self._numbers, range) else self._numbers[number]
            info["world"], world = number, env.pool[number]
        assignment = Assignment((goal_x, goal_y), world, world_key=number, start=(x, y, theta))
        episode = RunningEpisode(env.task, assignment)
        episode.state = State(goal=assignment.goal)
        length, first = int(self._steps[robot]), int(self._first_ticks[robot])
        track = self._tracks[robot, : length + 1]
        ticks, period = length * env.ticks_per_step, env.robot.config.period
        clock = np.cumsum(np.full(first + ticks, period))  # as the link adds up its periods
        return Episode(
            seed=self._resets[int(self._which[robot])][0],
            started=float(clock[first]) - period,
            ended=float(clock[-1]),
            length=length,
            ticks=ticks,
            episode_return=float(self._returns[robot]),
            energy=work,
            **measure_episode(
                env, episode, track, info, episode.shortest_path(known_pose(track[0].tolist()))
            ),
        )

"""Episodes of a policy, one after the other, or as a batch with the same results."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Generator, Iterable, Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.safety.rules import Reason
from acsar_gym.tasks.episode import Assignment
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tasks.task import says_shortest_path
from acsar_gym.tools.evaluation.episode import (
    TRACK_KEYS,
    Drive,
    Episode,
    Floats,
    Resets,
    known_pose,
    measure_episode,
)
from acsar_gym.tools.policies import FilePolicy, Policy
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.vector.env import RobotVectorEnv

MAX_LATE_SHARE = 0.01
"""Default of the largest share of late ticks in a valid episode."""
MIN_EPISODES = 16
"""Fewer episodes are driven one by one: making a batch takes longer than it saves."""
MAX_BATCH = 128
"""Most robots of a batch. A robot whose episode has ended starts the next episode."""
ENDINGS = ("start_x", "start_y", "start_theta", "goal_x", "goal_y", "work", "loops")
"""What is read of a robot of a batch when its episode ends. A loop is a period of its board."""


def run_episodes(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    count: int,
    seed: int,
    *,
    late_share: float = MAX_LATE_SHARE,
    **options: Any,
) -> Generator[Episode, None, None]:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and yield the result of each in order.

    Many episodes of planar robots are driven as a batch, with the same results, if the policy has
    no memory, see `make_batch`. A fault, or too many late ticks, make an episode invalid. After a
    fault, the next reset connects again.

    Args:
        env: Env of this package, wrapped or not.
        policy: Maps observations to actions. `reset()`, if it has that method, starts an episode,
            and `bind` gets the `PolicyContext` of the env, unless `make_env` gave it that.
        count: Number of episodes.
        seed: Seed of the first reset.
        late_share: Largest share of late ticks in a valid episode, 0 to 1.
        **options: Options of every reset.

    Yields:
        The result of each episode.

    Raises:
        ConfigError: `late_share` or `env` can't be used.
        LinkError: The robot can't be reached.
        EmergencyStopError: Its emergency stop was used.
    """
    resets = [(number, options) for number in range(seed, seed + count)]
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
    """Run episodes as `run_episodes`, with these seeds and options of their resets."""
    check_late_share(late_share)
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))

    batch = make_batch(env, policy, resets)
    drives: Iterable[Drive] = (_drive_env(env, inner, policy, *reset) for reset in resets)
    if batch is not None:
        drives = BatchDriver(inner, batch, policy, resets).drives()
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

    def make_row(reward: float) -> list[float]:
        return [*(info.get(key, math.nan) for key in TRACK_KEYS), reward]

    rows = [make_row(0.0)]
    way = inner.episode.shortest_path(known_pose(rows[0]))  # measured later: a robot doesn't wait
    is_done = False
    while not is_done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rows.append(make_row(float(reward)))
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise EmergencyStopError
        is_done = terminated or truncated
    return Drive(
        seed=seed,
        assignment=inner.episode.assignment,
        track=np.array(rows, np.float64),
        info=info,
        first_way=way,
        last_way=inner.episode.shortest_path(known_pose(rows[-1])),
        started=robot.wire.start,
        ended=robot.wire.stamp,
        energy=robot.link.work,
        timing=robot.timing,
    )


def make_batch(
    env: gymnasium.Env[Any, Any], policy: Policy, resets: Resets
) -> RobotVectorEnv | None:
    """Make the batch that drives these episodes. None if it can't, or if it isn't worth it."""
    inner: Any = env.unwrapped
    spec = copy.copy(env.spec)
    has_memory = getattr(policy, "act_many", None) is None
    if spec is None or has_memory or len(resets) < MIN_EPISODES or spec.additional_wrappers:
        return None
    is_planar = spec.kwargs.get("link") == "planar" and spec.vector_entry_point is not None

    # A path of the user's own may depend on the memory, which a batch doesn't give out.
    task = inner.task
    knows_ways = not says_shortest_path(task) or type(task).shortest_path is GoalTask.shortest_path

    # A batch has worlds by number. Those of several sets have names.
    has_numbers = inner.pool is None or inner.pool.numbers is not None
    fit = all(
        options.keys() <= {"world"} and isinstance(options.get("world", 0), int)
        for _, options in resets
    )
    if not (is_planar and knows_ways and has_numbers and fit):
        return None

    spec.kwargs = {**spec.kwargs, "autoreset_mode": AutoresetMode.NEXT_STEP}
    robots = min(len(resets), MAX_BATCH)
    try:
        batch = gymnasium.make_vec(spec, robots, vectorization_mode="vector_entry_point").unwrapped
    except ConfigError:  # an option, task or sensor that a batch doesn't have
        return None
    assert isinstance(batch, RobotVectorEnv)  # noqa: S101 - no other class is registered
    return batch


class BatchDriver:
    """The robots of a batch, which drive episodes. A free robot starts the next episode.

    Args:
        env: Env that would drive the episodes one by one.
        batch: Batch of robots, see `make_batch`.
        policy: A policy without memory.
        resets: Seeds and options of the episodes.
    """

    def __init__(self, env: RobotEnv, batch: RobotVectorEnv, policy: Any, resets: Resets) -> None:
        batch.batch.measure_work()
        self._env = env
        self._batch = batch
        self._policy = policy
        self._resets = resets
        self._waiting = iter(range(len(resets)))
        """Places of the episodes that haven't started, among the resets."""
        self._places: dict[int, int] = {}
        """Place of the episode that a robot drives."""
        self._tracks: list[list[Floats]] = [[] for _ in range(batch.num_envs)]

    def drives(self) -> Iterator[Drive]:
        """Drive, and yield each episode after all before it have ended."""
        finished: dict[int, Drive] = {}
        actions = np.zeros((self._batch.num_envs, 2), np.float32)
        with contextlib.closing(self._batch):
            observations = self._start()
            for place in range(len(self._resets)):
                while place not in finished:
                    robots = sorted(self._places)
                    actions[robots] = self._policy.act_many(observations[robots])
                    observations, rewards, terminated, truncated, info = self._batch.step(actions)
                    self._note(robots, info, rewards)

                    ended = [robot for robot in robots if terminated[robot] or truncated[robot]]
                    for robot in ended:
                        finished[self._places.pop(robot)] = self._finish(robot, info)
                    if ended:
                        observations = self._start(observations)
                yield finished.pop(place)

    def _start(self, observations: Any = None) -> Any:
        """Start the next episodes with free robots, and return the observations of all robots."""
        robots = self._batch.num_envs
        free = [robot for robot in range(robots) if robot not in self._places]
        started = dict(zip(free, self._waiting, strict=False))
        if not started:
            return observations

        seeds: list[int | None] = [None] * robots
        worlds = np.full(robots, math.nan)
        for robot, place in started.items():
            seed, options = self._resets[place]
            seeds[robot] = seed
            worlds[robot] = options.get("world", math.nan)
            self._tracks[robot] = []
        self._places |= started

        mask = np.isin(np.arange(robots), [*started])
        wishes = {"reset_mask": mask}
        if not np.isnan(worlds).all():
            wishes["world"] = worlds
        observations, info = self._batch.reset(seed=seeds, options=wishes)
        self._note(started, info, np.zeros(robots))
        return observations

    def _note(self, robots: Iterable[int], info: Mapping[str, Any], rewards: Floats) -> None:
        """Add a row to the tracks of these robots."""
        unknown = np.full(self._batch.num_envs, math.nan)
        rows = np.column_stack([*(info.get(key, unknown) for key in TRACK_KEYS), rewards])
        for robot in robots:
            self._tracks[robot].append(rows[robot])

    def _finish(self, robot: int, batch_info: Mapping[str, Any]) -> Drive:
        """Return the episode of a robot that has ended it."""
        info = {key: row[robot] for key, row in batch_info.items() if not key.startswith("_")}
        columns = self._batch.batch.read(*ENDINGS)[:, robot].tolist()
        x, y, theta, goal_x, goal_y, work, loops = columns

        # The assignment as the single env would have it.
        world = None
        number = -1
        if self._env.pool is not None:
            number = int(info["world"])
            world = self._env.pool[number]
        assignment = Assignment((goal_x, goal_y), world, world_key=number, start=(x, y, theta))
        way = np.array([assignment.goal]) if says_shortest_path(self._env.task) else None

        # The clock of a link adds up its periods, which rounds.
        config = self._env.robot.config
        track = np.array(self._tracks[robot])
        ticks = (len(track) - 1) * self._env.ticks_per_step
        last_tick = round(loops / round(config.firmware.loop_rate * config.period))
        clock = np.cumsum(np.full(last_tick, config.period))
        return Drive(
            seed=self._resets[self._places[robot]][0],
            assignment=assignment,
            track=track,
            info=info,
            first_way=way,
            last_way=way,
            started=float(clock[-ticks]) - config.period,
            ended=float(clock[-1]),
            energy=work,
        )

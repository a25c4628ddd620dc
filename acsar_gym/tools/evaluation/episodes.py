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


def run_resets(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    resets: Resets,
    late_share: float = MAX_LATE_SHARE,
) -> Generator[Episode, None, None]:
    """Run episodes as `run_episodes`, with these seeds and options of their resets."""
    if not 0.0 <= late_share <= 1.0:
        raise ConfigError(f"late_share = {late_share!r}: must be a share, 0 to 1")
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))

    batch = make_batch(env, policy, resets)
    drives: Iterable[Drive] = (_drive_env(env, inner, policy, *reset) for reset in resets)
    if batch is not None:
        drives = _drive_batch(inner, batch, policy, resets)
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


def _drive_batch(
    env: RobotEnv, batch: RobotVectorEnv, policy: Any, resets: Resets
) -> Iterator[Drive]:
    """Drive episodes with the robots of a batch. A free robot starts the next episode.

    Args:
        env: Env that would drive the episodes one by one.
        batch: Batch of robots, see `make_batch`. It is closed at the end.
        policy: A policy without memory.
        resets: Seeds and options of the episodes.

    Yields:
        Each episode, after all episodes before it have ended.
    """
    robots = batch.num_envs
    waiting = iter(range(len(resets)))
    places: dict[int, int] = {}  # by robot: place of its episode among the resets
    tracks: dict[int, list[Floats]] = {}
    finished: dict[int, Drive] = {}
    actions = np.zeros((robots, 2), np.float32)
    unknown = np.full(robots, math.nan)

    def note(drivers: Iterable[int], info: Mapping[str, Any], rewards: Floats) -> None:
        rows = np.column_stack([*(info.get(key, unknown) for key in TRACK_KEYS), rewards])
        for robot in drivers:
            tracks[robot].append(rows[robot])

    batch.batch.measure_work()
    with contextlib.closing(batch):
        for place in range(len(resets)):
            while place not in finished:
                # Free robots start the episodes that wait. All others stay as they are.
                free = [robot for robot in range(robots) if robot not in places]
                if started := dict(zip(free, waiting, strict=False)):
                    places |= started
                    tracks |= {robot: [] for robot in started}
                    observations, info = _reset_robots(batch, started, resets)
                    note(started, info, np.zeros(robots))

                active = sorted(places)
                actions[active] = policy.act_many(observations[active])
                observations, rewards, terminated, truncated, info = batch.step(actions)
                note(active, info, rewards)
                for robot in active:
                    if terminated[robot] or truncated[robot]:
                        end = {key: row[robot] for key, row in info.items() if key[0] != "_"}
                        numbers = batch.batch.read(*ENDINGS)[:, robot].tolist()
                        seed, _ = resets[places[robot]]
                        drive = _finish_drive(env, seed, np.array(tracks[robot]), end, numbers)
                        finished[places.pop(robot)] = drive
            yield finished.pop(place)


def _reset_robots(batch: RobotVectorEnv, started: Mapping[int, int], resets: Resets) -> Any:
    """Start episodes, by robot and place among the resets: observations and info of all robots."""
    robots = batch.num_envs
    seeds: list[int | None] = [None] * robots
    worlds = np.full(robots, math.nan)
    for robot, place in started.items():
        seeds[robot], options = resets[place]
        worlds[robot] = options.get("world", math.nan)

    wishes = {"reset_mask": np.isin(np.arange(robots), [*started])}
    if not np.isnan(worlds).all():
        wishes["world"] = worlds
    return batch.reset(seed=seeds, options=wishes)


def _finish_drive(
    env: RobotEnv, seed: int, track: Floats, info: Mapping[str, Any], numbers: list[float]
) -> Drive:
    """Return the episode of a robot that has ended it with these numbers of ENDINGS."""
    x, y, theta, goal_x, goal_y, work, loops = numbers

    # The assignment as the single env would have it.
    world = None
    number = -1
    if env.pool is not None:
        number = int(info["world"])
        world = env.pool[number]
    assignment = Assignment((goal_x, goal_y), world, world_key=number, start=(x, y, theta))
    way = np.array([assignment.goal]) if says_shortest_path(env.task) else None

    # The clock of a link adds up its periods, which rounds.
    config = env.robot.config
    last_tick = round(loops / round(config.firmware.loop_rate * config.period))
    clock = np.cumsum(np.full(last_tick, config.period))
    first_tick = last_tick - (len(track) - 1) * env.ticks_per_step
    return Drive(
        seed=seed,
        assignment=assignment,
        track=track,
        info=info,
        first_way=way,
        last_way=way,
        started=float(clock[first_tick]) - config.period,
        ended=float(clock[-1]),
        energy=work,
    )

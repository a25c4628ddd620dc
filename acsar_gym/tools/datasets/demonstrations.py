"""What agents saw and did, by recordings, in the steps of an env.

Steps that an env has recorded are taken as they are. A drive without an env, such as a person's
with `acsar-gym drive`, is replayed: an env gets the recorded bytes as its link, so that its
observations are those that an agent would have had.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.envs.ids import find_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable
from acsar_gym.recording import Recording, read
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.recording.types import Episode, Floats
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors import LIDAR
from acsar_gym.tasks.goal import PointGoal
from acsar_gym.tasks.state import Goal
from acsar_gym.worlds import Scene

DEFAULT_ENV = "point_goal"  # the env of drives that were recorded without an env
DEFAULT_RATE = 10.0  # env steps per second of a recording with a single observation [Hz]


@dataclass(frozen=True, eq=False)
class DemonstrationEpisode:
    """One episode of n env steps."""

    observations: NDArray[np.float32]
    """(n + 1, numbers): before the first step, and after each."""
    actions: NDArray[np.float32]
    """(n, 2): linear and angular, in [-1, 1]."""
    rewards: NDArray[np.float64]
    """(n,)."""
    terminated: bool
    """Whether it ended by success or failure. It was cut short otherwise."""
    seed: int | None = None
    """Of the env's reset. None if it isn't known."""


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Episodes of one env, of one recording or several."""

    env_id: str
    """Id of the env. "" if an env without an id recorded them."""
    names: tuple[str, ...]
    """Names of the observation's numbers."""
    rate: float
    """Env steps per second [Hz]."""
    robot: str
    """Name of the robot."""
    speeds: tuple[float, float]
    """Linear and angular speed that an action of 1 asks for [m/s, rad/s]."""
    policy: str
    """File of the policy that drove, or of several. "unknown" for a person."""
    episodes: tuple[DemonstrationEpisode, ...]

    @property
    def steps(self) -> int:
        """Number of steps of all episodes."""
        return sum(len(episode.actions) for episode in self.episodes)


def read_demonstrations(
    paths: Sequence[Path], env: str = "", goal: Goal | None = None
) -> Demonstrations:
    """Read the episodes of recordings as steps of an env.

    Args:
        paths: The recordings.
        env: Id or short name of an env with a goal, whose observations are made of what was
            recorded. "" takes the steps that an env recorded, and point_goal for other drives.
        goal: Goal x, y in the odometry frame [m]. None takes the goal that was recorded, or
            the place at which the drive ended.

    Raises:
        ConfigError: A recording can't be read, has no whole episode, or doesn't fit the env or the
            recordings before it.
    """
    recordings = [_read_recording(path, env, goal) for path in paths]

    first = recordings[0]
    for path, recording in zip(paths, recordings, strict=True):
        for field in ("env_id", "names", "rate", "speeds"):
            value = getattr(recording, field)
            expected = getattr(first, field)
            if value != expected:
                difference = "not" if field == "names" else f"{value!r}, not {expected!r}"
                raise ConfigError(
                    f"{path}: {field} are {difference} as in {paths[0]}: "
                    "give --env, or export them to data sets of their own"
                )
    return replace(
        first,
        policy=", ".join(dict.fromkeys(recording.policy for recording in recordings)),
        episodes=tuple(episode for recording in recordings for episode in recording.episodes),
    )


def _read_recording(path: Path, env: str, goal: Goal | None) -> Demonstrations:
    recording = read(path)
    if recording.cut:
        loss = "the last episode is left out" if recording.is_incomplete else "its end is missing"
        warnings.warn(f"{path}: the file is cut: {loss}", RecordingWarning, stacklevel=4)
    complete = recording.episodes[: len(recording.episodes) - recording.is_incomplete]
    about = recording.header["about"]
    recorded_env = _look_up(about, "env", "id")

    stepped = [episode for episode in complete if _has_steps(episode)]
    if stepped and not env and goal is None:
        # The numbers that the env saw are in the file: nothing has to be replayed.
        env_id = recorded_env
        names = [str(name) for name in about.get("observation", ())]
        rate = _find_rate(stepped[0], recording.config.control_rate)
        episodes = [_take_steps(episode) for episode in stepped]
    else:
        # Only the user, not the file, may name an env of another package, which is imported.
        env_id = find_id(env or strip_module(recorded_env) or DEFAULT_ENV)
        replayed = _make_replay_env(env_id, path, recording, goal)
        try:
            episodes = list(_replay_episodes(replayed, path, complete, goal))
        finally:
            replayed.close()
        if not episodes:
            lacking = "whole episode" if recording.is_incomplete else "episode that fits"
            raise ConfigError(f"{path}: holds no {lacking}: drive from a start to another place")
        env_id = strip_module(env_id)
        names = list(replayed.task.observation)
        rate = float(replayed.metadata["render_fps"])

    size = episodes[0].observations.shape[1]
    sensed = [f"sensed_{number}" for number in range(size - len(names))]
    config = recording.config
    return Demonstrations(
        env_id=env_id,
        names=(*names[:size], *sensed),
        rate=rate,
        robot=config.name,
        speeds=(config.max_linear, config.max_angular),
        policy=_look_up(about, "policy", "file") or "unknown",
        episodes=tuple(episodes),
    )


def _look_up(about: Mapping[str, Any], name: str, key: str) -> str:
    """An entry of a mapping in the header. Empty if it isn't there."""
    entry = about.get(name)
    return str(entry.get(key) or "") if isinstance(entry, Mapping) else ""


def _has_steps(episode: Episode) -> bool:
    """Whether an env recorded the episode, whole, and it has a step that no fault ended."""
    # A slow disk or a damaged file may have cost steps.
    steps = episode.tables["steps"]["step"]
    is_whole = np.array_equal(steps, np.arange(len(steps)))
    return is_whole and len(episode.actions) > episode.truncated


def _take_steps(episode: Episode) -> DemonstrationEpisode:
    """The steps that an env has recorded, but for one that a fault ended, which saw nothing new."""
    seed = episode.info.get("seed")
    count = len(episode.actions) - episode.truncated
    return DemonstrationEpisode(
        observations=np.array(episode.observations[: count + 1]),
        actions=np.array(episode.actions[:count]),
        rewards=np.array(episode.rewards[:count]),
        terminated=episode.terminated,
        seed=seed if isinstance(seed, int) else None,
    )


def _find_rate(episode: Episode, control_rate: float) -> float:
    """Env steps per second, by the number of ticks of a recorded step."""
    if len(episode.step_stamps) < 2:
        return DEFAULT_RATE
    # A median ignores a program's pause between two steps.
    ticks = round(float(np.median(np.diff(episode.step_stamps))) * control_rate)
    return control_rate / max(ticks, 1)


def _make_replay_env(env_id: str, path: Path, recording: Recording, goal: Goal | None) -> RobotEnv:
    """Make the env that plays the episodes. Goals may be as far away as the robot drove."""
    config = recording.config.with_(wheel_check=False)  # these wheels can't be hurt any more

    def make(**options: Any) -> RobotEnv:
        link = ReplayLink(path, compare=False)  # an action is the mean of a step's commands
        try:
            wrapped = gymnasium.make(env_id, link=link, robot=config, on_fault="raise", **options)
        except TypeError as error:
            raise ConfigError(f"{env_id}: can't replay a recording: {error}") from error
        env = wrapped.unwrapped  # without the limit of time
        if not isinstance(env, RobotEnv) or env.task.follows:
            raise ConfigError(
                f"{env_id}: has no goal: choose an env with a goal, such as point_goal"
            )
        return env

    env = make()
    # A LiDAR can't be made of odometry.
    has_scans = any(len(episode.scans.stamps) for episode in recording.episodes)
    if any(sensor.name == LIDAR for sensor in env.sensors) and not has_scans:
        raise ConfigError(f"{path}: has no scans, which {env_id} observes: record with a LiDAR")

    # A robot may have driven farther than the env's goals are.
    if isinstance(env.task, PointGoal):
        nearest, farthest = env.task.goal_distance
        places = [
            np.concatenate([episode.poses[:, :2], [_find_goal(episode, goal)]])
            for episode in recording.episodes
        ]
        reach = float(np.hypot(*np.concatenate(places).T).max())
        if reach > farthest:
            return make(goal_distance=(nearest, reach), distance_scale=env.task.scale)
    return env


def _find_goal(episode: Episode, goal: Goal | None) -> Goal:
    """The goal that was asked for, or that was recorded, or else the place where it ended."""
    if goal is not None:
        return goal
    x, y = episode.poses[-1, :2].tolist() if len(episode.poses) else (0.0, 0.0)
    with contextlib.suppress(TypeError, ValueError):  # a drive without a goal
        x, y = map(float, episode.info.get("goal") or ())
    return x, y


def _replay_episodes(
    env: RobotEnv, path: Path, episodes: Sequence[Episode], goal: Goal | None
) -> Iterator[DemonstrationEpisode]:
    """Replay episodes through an env, and warn of those that are left out."""
    nearest = max(env.task.goal_distance[0], env.task.goal_tolerance)
    for number, episode in enumerate(episodes):
        # What was asked for after the robot was stopped isn't driven.
        stopped = np.isin(episode.reasons, (Reason.EMERGENCY_STOP, Reason.STALE_FEEDBACK))
        twists = episode.asked[np.cumsum(stopped) == 0]
        end = _find_goal(episode, goal)
        distance = float(np.hypot(*end))
        problem = ""
        if len(twists) < env.ticks_per_step:
            problem = "it is shorter than a step"
        elif goal is None and distance < nearest:
            problem = f"its goal is {distance:.2f} m from its start, less than {nearest:g} m"
        if not problem:
            yield _replay_episode(env, f"{path}: episode {number}", twists, end)
            continue

        if len(episode.asked):  # the robot wasn't only made ready
            text = f"{path}: episode {number} is left out: {problem}"
            warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=5)
        env.robot.link.open()
        env.robot.link.reset(Scene())  # the next episode begins


def _replay_episode(env: RobotEnv, name: str, twists: Floats, goal: Goal) -> DemonstrationEpisode:
    """Replay one episode by the twists asked for (n, 2), to their end or the env's episode's."""
    ticks = env.ticks_per_step
    count = len(twists) // ticks
    # A policy acts once a step, a person at any tick.
    means = twists[: count * ticks].reshape(count, ticks, 2).mean(axis=1)
    if not np.isfinite(means).all():
        raise ConfigError(f"{name} has ticks without a command: it is no demonstration")
    config = env.robot.config
    actions = np.clip(means / (config.max_linear, config.max_angular), -1.0, 1.0)
    # Rounded before the replay, so that the env gets exactly the actions of the data.
    actions = actions.astype(np.float32)

    observations = [env.reset(options={"goal": goal})[0]]
    rewards: list[float] = []
    terminated = False
    for action in actions:
        observation, reward, terminated, _, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        if terminated:
            break
    return DemonstrationEpisode(
        observations=np.array(observations),
        actions=actions[: len(rewards)],
        rewards=np.array(rewards),
        terminated=terminated,
    )

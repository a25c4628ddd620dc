"""What agents saw and did, by recordings, in the steps of an env.

Steps that an env has recorded are taken as they are. A drive without an env, such as a person's
with `acsar-gym drive`, is replayed: an env gets the recorded bytes as its link, so that its
observations are those that an agent would have had.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import find_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable
from acsar_gym.recording import read
from acsar_gym.recording.export import is_incomplete
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.recording.types import Episode, Floats
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors import LIDAR
from acsar_gym.tasks.goal import PointGoal
from acsar_gym.tasks.state import Goal
from acsar_gym.worlds import Scene

DEFAULT_ENV = "point_goal"  # the env of drives that were recorded without one
DEFAULT_RATE = 10.0  # the env steps per second where the recording doesn't tell [Hz]


@dataclass(frozen=True, eq=False)
class DemonstrationEpisode:
    """One episode of n env steps."""

    observations: NDArray[np.float32]  # (n + 1, numbers): before the first step, and after each
    actions: NDArray[np.float32]  # (n, 2): linear and angular, in [-1, 1]
    rewards: NDArray[np.float64]  # (n,)
    terminated: bool  # whether it ended by success or failure; it was cut short otherwise
    seed: int | None = None  # of the env's reset; None where it isn't known


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Episodes of one env, of one recording or several."""

    env_id: str  # the id of the env; "" where an env without an id recorded them
    names: tuple[str, ...]  # names of the observation's numbers
    rate: float  # env steps per second [Hz]
    robot: str  # name of the robot
    speeds: tuple[float, float]
    """Linear and angular speed that an action of 1 asks for [m/s, rad/s]."""
    policy: str  # file of the policy that drove, or of those; "unknown" for a person
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
        paths: of the recordings.
        env: id or short name of an env with a goal, whose observations are made of what was
            recorded; "" takes the steps that an env recorded, and point_goal for drives without.
        goal: x, y in the odometry frame [m]; None for the one that was recorded, and where there
            was none, for the place at which the drive ended.

    Raises:
        ConfigError: a recording can't be read, has no whole episode, or doesn't fit the env or the
            recordings before it.
    """
    recordings = [_read_one(path, env, goal) for path in paths]
    first = recordings[0]
    for path, other in zip(paths, recordings, strict=True):
        for field in ("env_id", "names", "rate", "speeds"):
            value, wanted = getattr(other, field), getattr(first, field)
            if value != wanted:
                what = f"{value!r}, not {wanted!r}" if field != "names" else "not"
                raise ConfigError(
                    f"{path}: {field} are {what} as in {paths[0]}: "
                    "give --env, or export them to data sets of their own"
                )
    episodes = tuple(episode for recording in recordings for episode in recording.episodes)
    policies = ", ".join(dict.fromkeys(recording.policy for recording in recordings))
    return replace(first, policy=policies, episodes=episodes)


def _read_one(path: Path, env: str, goal: Goal | None) -> Demonstrations:
    """Read one recording."""
    recording = read(path)
    if recording.cut:
        last = "the last episode is left out" if is_incomplete(recording) else "its end is missing"
        warnings.warn(f"{path}: the file is cut: {last}", RecordingWarning, stacklevel=4)
    episodes = recording.episodes
    whole = episodes[: len(episodes) - is_incomplete(recording)]
    about = recording.header["about"]
    named = about.get("env")
    named = str(named.get("id", "")) if isinstance(named, Mapping) else ""
    policy = about.get("policy")
    config = recording.config
    told: dict[str, Any] = {
        "robot": config.name,
        "speeds": (config.max_linear, config.max_angular),
        "policy": str(policy.get("file", "unknown")) if isinstance(policy, Mapping) else "unknown",
    }
    stepped = [one for one in whole if _has_steps(one)]
    if stepped and not env and goal is None:
        size = stepped[0].observations.shape[1]
        names = _name_numbers([str(name) for name in about.get("observation", ())], size)
        rate = _step_rate(stepped[0], recording.config.control_rate)
        made = tuple(_take_steps(one) for one in stepped)
        return Demonstrations(named, names, rate, **told, episodes=made)
    # Only the user, not the file, may name an env of another package, which is imported.
    env_id = find_id(env or strip_module(named) or DEFAULT_ENV)
    made_env = _make_replay_env(env_id, path, recording.config, episodes, goal)
    try:
        made = tuple(_replay_steps(made_env, path, whole, goal))
    finally:
        made_env.close()
    if not made:
        what = "whole episode" if is_incomplete(recording) else "episode that fits"
        raise ConfigError(f"{path}: holds no {what}: drive from a start to another place")
    names = _name_numbers(list(made_env.task.observation), made[0].observations.shape[1])
    rate = float(made_env.metadata["render_fps"])
    return Demonstrations(strip_module(env_id), names, rate, **told, episodes=made)


def _has_steps(episode: Episode) -> bool:
    """Whether an env recorded the episode, whole, and it has a step that no fault ended."""
    count = len(episode.actions)
    return (
        count > episode.truncated
        and len(episode.observations) == count + 1
        and len(episode.rewards) == count
    )


def _take_steps(episode: Episode) -> DemonstrationEpisode:
    """The steps that an env has recorded, but for one that a fault ended, which saw nothing new."""
    seed = episode.info.get("seed")
    count = len(episode.actions) - episode.truncated
    return DemonstrationEpisode(
        np.array(episode.observations[: count + 1]),
        np.array(episode.actions[:count]),
        np.array(episode.rewards[:count]),
        episode.terminated,
        seed if isinstance(seed, int) else None,
    )


def _step_rate(episode: Episode, control_rate: float) -> float:
    """Env steps per second, by how many ticks a recorded step has."""
    if len(episode.step_stamps) < 2:
        return DEFAULT_RATE
    ticks = round(float(np.median(np.diff(episode.step_stamps))) * control_rate)
    return control_rate / max(ticks, 1)


def _name_numbers(names: list[str], size: int) -> tuple[str, ...]:
    """Names of an observation's numbers: those of the task, then those of the sensors."""
    return (*names[:size], *(f"sensed_{number}" for number in range(size - len(names))))


def _make_replay_env(
    env_id: str, path: Path, robot: RobotConfig, episodes: Sequence[Episode], goal: Goal | None
) -> RobotEnv:
    """Make the env that plays the episodes; goals may be as far away as the robot drove."""
    config = robot.with_(wheel_check=False)  # these wheels can't be hurt any more

    def make(**options: Any) -> RobotEnv:
        link = ReplayLink(path, compare=False)  # an action is the mean of a step's commands
        try:
            made = gymnasium.make(env_id, link=link, robot=config, on_fault="raise", **options)
        except TypeError as error:
            raise ConfigError(f"{env_id}: can't replay a recording: {error}") from error
        env = made.unwrapped  # without the limit of time
        if not isinstance(env, RobotEnv) or env.task.follows:
            raise ConfigError(f"{env_id}: has no goal: choose an env with one, such as point_goal")
        return env

    env = make()
    if any(sensor.name == LIDAR for sensor in env.sensors) and not any(
        len(episode.scans.stamps) for episode in episodes
    ):
        raise ConfigError(f"{path}: has no scans, which {env_id} observes: record with a LiDAR")
    if isinstance(env.task, PointGoal):
        nearest, farthest = env.task.goal_distance
        reach = max(_find_reach(episode, goal) for episode in episodes)
        if reach > farthest:
            return make(goal_distance=(nearest, reach), distance_scale=env.task.scale)
    return env


def _find_reach(episode: Episode, goal: Goal | None) -> float:
    """The longest distance of robot and goal from where the episode began [m]."""
    places = np.concatenate([episode.poses[:, :2], [_find_goal(episode, goal)]])
    return float(np.hypot(*places.T).max())


def _find_goal(episode: Episode, goal: Goal | None) -> Goal:
    """The goal that is asked for; else the recorded one; else the place where the drive ended."""
    if goal is not None:
        return goal
    told = episode.info.get("goal")
    if isinstance(told, list) and len(told) == 2 and all(isinstance(n, int | float) for n in told):
        return float(told[0]), float(told[1])
    x, y = episode.poses[-1, :2].tolist() if len(episode.poses) else (0.0, 0.0)
    return x, y


def _take_driven(episode: Episode) -> Floats:
    """The twists asked for (n, 2), until the robot was stopped against them."""
    stopped = np.isin(episode.reasons, (Reason.EMERGENCY_STOP, Reason.STALE_FEEDBACK))
    return episode.asked[: np.argmax(stopped)] if stopped.any() else episode.asked


def _replay_steps(
    env: RobotEnv, path: Path, episodes: Sequence[Episode], goal: Goal | None
) -> Iterator[DemonstrationEpisode]:
    """Replay episodes through an env; warns of those that are left out."""
    nearest = max(env.task.goal_distance[0], env.task.goal_tolerance)
    for number, episode in enumerate(episodes):
        end, asked = _find_goal(episode, goal), _take_driven(episode)
        distance, why = float(np.hypot(*end)), ""
        if len(asked) < env.ticks_per_step:
            why = "it is shorter than a step"
        elif goal is None and distance < nearest:
            why = f"its goal is {distance:.2f} m from its start, less than {nearest:g} m"
        if why:
            if len(episode.asked):  # not where the robot was only made ready
                left = f"{path}: episode {number} is left out: {why}"
                warnings.warn(escape_unprintable(left), RecordingWarning, stacklevel=5)
            env.robot.link.open()
            env.robot.link.reset(Scene())  # the next one begins
            continue
        yield _replay_episode(env, path, number, asked, end)


def _replay_episode(
    env: RobotEnv, path: Path, number: int, twists: Floats, goal: Goal
) -> DemonstrationEpisode:
    """Replay one episode by the twists asked for (n, 2), to their end or the env's episode's."""
    ticks = env.ticks_per_step
    count = len(twists) // ticks
    asked = twists[: count * ticks].reshape(count, ticks, 2).mean(axis=1)
    if not np.isfinite(asked).all():
        raise ConfigError(
            f"{path}: episode {number} has ticks without a command: it is no demonstration"
        )
    config = env.robot.config
    actions = np.clip(asked / (config.max_linear, config.max_angular), -1.0, 1.0)
    actions = actions.astype(np.float32)
    observations, rewards, over = [env.reset(options={"goal": goal})[0]], [], False
    for action in actions:
        observation, reward, over, _, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        if over:
            break
    done = len(rewards)
    return DemonstrationEpisode(np.array(observations), actions[:done], np.array(rewards), over)

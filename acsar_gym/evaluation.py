"""Episodes of a policy, and what they add up to."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from acsar_gym.env import PointGoalEnv
from acsar_gym.errors import ConfigError
from acsar_gym.policy import Policy
from acsar_gym.worlds import Pose


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One episode, as odometry and the link's clock saw it."""

    success: bool
    started: float
    """The link's clock at the reset [s]."""
    ended: float
    """The link's clock at the end [s]."""
    path: float
    """Length of the path driven, by odometry [m]."""
    pose: Pose
    """Odometry at the end (x [m], y [m], theta [rad])."""
    odometry_error: float
    """Distance between odometry and truth at the end [m]; NaN where there is no truth."""
    ticks: int
    late_ticks: int
    """Ticks that ended over a millisecond late; 0 in simulation."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Means over episodes; NaN where there is nothing to average."""

    episodes: int
    success_rate: float
    time_to_goal: float
    """Over successes [s]."""
    path: float
    """Over successes [m]."""
    odometry_error: float
    """At the end of an episode [m]."""
    ticks: int
    late_ticks: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON: NaN becomes None."""
        return {
            key: None if isinstance(value, float) and math.isnan(value) else value
            for key, value in asdict(self).items()
        }


def episodes(
    env: gymnasium.Env[Any, Any], policy: Policy, count: int, seed: int, **options: Any
) -> Iterator[EpisodeResult]:
    """Run `count` episodes, seeds `seed`, `seed + 1`, ...; `options` go to every reset."""
    for number in range(count):
        yield _episode(env, policy, seed + number, options)


def _episode(
    env: gymnasium.Env[Any, Any], policy: Policy, seed: int, options: dict[str, Any]
) -> EpisodeResult:
    unwrapped = env.unwrapped
    if not isinstance(unwrapped, PointGoalEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    observation, info = env.reset(seed=seed, options=options)
    link, done, path, ticks = unwrapped.robot.link, False, 0.0, 0
    started, late = link.now(), link.late_ticks
    while not done:
        x, y = info["odom_x"], info["odom_y"]
        observation, _, terminated, truncated, info = env.step(policy(observation))
        path += math.hypot(info["odom_x"] - x, info["odom_y"] - y)
        ticks += unwrapped.ticks_per_step
        done = terminated or truncated
    unwrapped.robot.stop()  # a time limit is no concern of the env below it
    return EpisodeResult(
        success=info["is_success"] == 1.0,
        started=started,
        ended=link.now(),
        path=path,
        pose=(info["odom_x"], info["odom_y"], info["odom_theta"]),
        odometry_error=info["odometry_error"],
        ticks=ticks,
        late_ticks=link.late_ticks - late,
    )


def summarise(results: Sequence[EpisodeResult]) -> Summary:
    """Rates and means of a list of episodes."""
    wins = [result for result in results if result.success]
    return Summary(
        episodes=len(results),
        success_rate=_mean([float(result.success) for result in results]),
        time_to_goal=_mean([result.ended - result.started for result in wins]),
        path=_mean([result.path for result in wins]),
        odometry_error=_mean([result.odometry_error for result in results]),
        ticks=sum(result.ticks for result in results),
        late_ticks=sum(result.late_ticks for result in results),
    )


def odometry_errors(results: Sequence[EpisodeResult], log: Path) -> list[float]:
    """Distance between odometry and truth at each episode's end [m], from an emulator's log.

    The emulator's robot isn't put back between episodes, so truth is taken relative to where it
    stood at the reset. Both clocks are the monotonic clock of the machine.
    """
    stamps, poses = _true_poses(log)
    errors = []
    for result in results:
        start = poses[_latest(stamps, result.started)]
        end = poses[_latest(stamps, result.ended)]
        x, y = _relative(start, end)
        errors.append(math.hypot(x - result.pose[0], y - result.pose[1]))
    return errors


def _true_poses(log: Path) -> tuple[list[float], list[Pose]]:
    events = [json.loads(line) for line in log.read_text(encoding="ascii").splitlines()]
    truths = [event for event in events if "pose" in event]
    if not truths:
        raise ConfigError(f"{log}: holds no true poses; run 'acsar-gym emulate --log FILE'")
    return [event["t"] for event in truths], [tuple(event["pose"]) for event in truths]


def _latest(stamps: list[float], time: float) -> int:
    return max(0, int(np.searchsorted(stamps, time, side="right")) - 1)


def _relative(start: Pose, end: Pose) -> tuple[float, float]:
    """Where `end` lies as seen from `start`."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    c, s = math.cos(start[2]), math.sin(start[2])
    return c * dx + s * dy, c * dy - s * dx


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan

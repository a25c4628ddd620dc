"""What two sides of a comparison must have in common, and what makes them unlike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError
from acsar_gym.links.lateness import LATE
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.worlds.scene import to_odometry

Named = Sequence[tuple[str, Recording]]
"""Recordings with the names of their files."""
NEAR = 0.01
"""Goals that are nearer to each other are one [m]."""
LATE_SHARE = 0.01
"""An episode in which a larger share of the ticks is late isn't valid, as for `evaluate`."""
KINDS = {True: "a simulated robot", False: "a real robot"}


def _about(recording: Recording) -> Mapping[str, Any]:
    """Return what the program said about a recording."""
    about = recording.header.get("about")
    return about if isinstance(about, Mapping) else {}


def _task_of(recording: Recording) -> str:
    """Return the id of the env that was recorded; empty if there was none."""
    env = _about(recording).get("env")
    return str(env.get("id") or "") if isinstance(env, Mapping) else ""


def labels(recording: Recording) -> tuple[str, ...]:
    """Return the names of the task's numbers in an observation; empty if they aren't known."""
    names = _about(recording).get("observation")
    return tuple(str(name)[:40] for name in names) if isinstance(names, list) else ()


def task(logs: Named) -> str:
    """Return the task of all recordings; ConfigError if they have different ones."""
    first = _task_of(logs[0][1])
    for name, recording in logs[1:]:
        other = _task_of(recording)
        if other != first:
            raise ConfigError(
                f"{name}: is of {other or 'no task'}, but {logs[0][0]} of {first or 'no task'}"
            )
    return first


def is_simulated(recording: Recording) -> bool:
    """Whether the robot was simulated; only then, ticks have no lateness."""
    return all(bool(np.isnan(one.lateness).all()) for one in recording.episodes)


def kinds(first: Named, second: Named, names: tuple[str, str]) -> list[str]:
    """Say which recordings aren't of the kind of their side.

    Args:
        first: of the simulation.
        second: of the robot.
        names: what the sides are called.

    Raises:
        ConfigError: the sides are swapped.
    """
    found = [[is_simulated(log) for _, log in side] for side in (first, second)]
    if not any(found[0]) and all(found[1]):
        raise ConfigError(
            f"{first[0][0]}: is of a real robot, and {second[0][0]} of a simulated one: name the "
            "simulation first"
        )
    return [
        f"{name}: is of {KINDS[kind]}, but named as {side}"
        for side, wanted, logs, own in zip(
            names, (True, False), (first, second), found, strict=True
        )
        for (name, _), kind in zip(logs, own, strict=True)
        if kind != wanted
    ]


def policies(first: Named, second: Named) -> str:
    """Say that the policies differ; empty if they don't, as far as the recordings tell."""
    named = [{_policy(log) for _, log in side} for side in (first, second)]
    if len(named[0] | named[1]) < 2:
        return ""
    told = [", ".join(sorted(name for _, name in side)) for side in named]
    return f"policies differ: {told[0]} vs {told[1]}"


def _policy(recording: Recording) -> tuple[str, str]:
    """Hash and short name of the policy that drove."""
    policy = _about(recording).get("policy")
    if not isinstance(policy, Mapping):
        return "", str(policy or "none told")[:60]
    sha256 = str(policy.get("sha256") or "")
    name = Path(str(policy.get("file") or "unnamed")).name[:60]
    return sha256, f"{name} ({sha256[:8]})" if sha256 else name


def same_goal(one: Episode, other: Episode) -> bool:
    """Whether two episodes had the same goal, seen from their starts; true where it isn't told."""
    goals = [_goal(episode) for episode in (one, other)]
    if goals[0] is None or goals[1] is None:
        return True
    return float(np.hypot(*np.subtract(goals[0], goals[1]))) < NEAR


def _goal(episode: Episode) -> tuple[float, float] | None:
    """The goal in the frame of the start [m]; None if it isn't told."""
    goal, start = episode.info.get("goal"), episode.info.get("start") or (0.0, 0.0, 0.0)
    if not goal:
        return None
    x, y, _ = to_odometry(tuple(start), (float(goal[0]), float(goal[1]), 0.0))
    return x, y


def late(name: str, episode: Episode) -> list[str]:
    """Say that an episode isn't valid because too many of its ticks were late."""
    known = episode.lateness[np.isfinite(episode.lateness)]
    share = float(np.mean(known > LATE)) if len(known) else 0.0
    if share <= LATE_SHARE:
        return []
    return [f"{name}: invalid, {share:.0%} of its ticks were late; it was compared all the same"]

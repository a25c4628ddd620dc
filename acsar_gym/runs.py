"""What `evaluate` and `run` do: a policy file driving behind any link."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import gymnasium
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from acsar_gym import evaluation
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import EpisodeResult
from acsar_gym.links import Link, open_link
from acsar_gym.links.recording import RecordingLink
from acsar_gym.policy import ENV_ID, OnnxPolicy


def evaluate(
    policy: str, link: str, robot: str | None, episodes: int, seed: int
) -> list[EpisodeResult]:
    """Episodes with random goals, behind a progress bar."""
    if episodes < 1 or seed < 0:
        raise ConfigError("--episodes must be at least 1 and --seed at least 0")
    return drive(OnnxPolicy(policy), link, robot, episodes, seed)


def drive(
    policy: OnnxPolicy, link: str, robot: str | None, count: int, seed: int
) -> list[EpisodeResult]:
    """Episodes of a loaded policy behind a link, which is closed whatever happens."""
    env = gymnasium.make(ENV_ID, link=link, robot=robot)
    try:
        return track(link, evaluation.episodes(env, policy, count, seed), count)
    finally:
        env.close()


def to_goal(
    policy: str, link: str, robot: str | None, goal: tuple[float, float], record: Path | None
) -> EpisodeResult:
    """One episode to a given goal, recorded to a file on request."""
    config = RobotConfig.of(robot)
    actor = OnnxPolicy(policy)
    wire: Link = open_link(link, config)
    if record is not None:
        wire = RecordingLink(wire, record)
    env = gymnasium.make(ENV_ID, link=wire, robot=config)
    try:
        return next(evaluation.episodes(env, actor, 1, seed=0, goal=goal))
    finally:
        env.close()


def track(name: str, running: Iterator[EpisodeResult], count: int) -> list[EpisodeResult]:
    """Collect episodes behind a progress bar that shows the success rate."""
    results: list[EpisodeResult] = []
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes, success {task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns) as progress:
        task = progress.add_task(name, total=count, rate="-")
        for result in running:
            results.append(result)
            rate = evaluation.summarise(results).success_rate
            progress.update(task, advance=1, rate="-" if math.isnan(rate) else f"{rate:.0%}")
    return results

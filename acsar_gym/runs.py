"""What `evaluate` and `run` do: a policy file driving behind any link."""

from __future__ import annotations

from pathlib import Path

import gymnasium

from acsar_gym import evaluation
from acsar_gym.config import RobotConfig
from acsar_gym.demo import track
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import EpisodeResult
from acsar_gym.links import Link, open_link
from acsar_gym.links.recording import RecordingLink
from acsar_gym.policy import OnnxPolicy


def evaluate(
    policy: str, link: str, robot: str | None, episodes: int, seed: int
) -> list[EpisodeResult]:
    """Episodes with random goals, behind a progress bar."""
    if episodes < 1 or seed < 0:
        raise ConfigError("--episodes must be at least 1 and --seed at least 0")
    actor = OnnxPolicy(policy)
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=robot)
    try:
        return track(link, evaluation.episodes(env, actor, episodes, seed), episodes)
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
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=wire, robot=config)
    try:
        return next(evaluation.episodes(env, actor, 1, seed=0, goal=goal))
    finally:
        env.close()

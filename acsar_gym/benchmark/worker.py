"""Runs one job of a benchmark, in whatever process it is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from acsar_gym.benchmark import port
from acsar_gym.benchmark.conditions import CONDITIONS
from acsar_gym.benchmark.figures import Scoring, episode_of
from acsar_gym.benchmark.plan import PLANAR, PORT, Job
from acsar_gym.benchmark.scenes import SceneSet
from acsar_gym.benchmark.store import Part
from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import runs
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.policies import FilePolicy


def run(job: Job) -> Part:
    """Drive the scenes of a job.

    Args:
        job: what to drive.

    Returns:
        The episodes; or why the agent can't drive there, such as another observation.

    Raises:
        LinkError: an emulated port couldn't be opened.
    """
    begin = time.process_time()
    places = range(job.first, job.first + job.count)
    drive = port.results if job.cell.link == PORT else _simulated
    try:
        env, policy = _prepared(
            job.policy, job.env, _simulation(job), job.cell.condition, job.scenes
        )
        scoring = Scoring(
            job.cell.id, env.unwrapped.robot.config.max_linear, env.unwrapped.task.goal_tolerance
        )
        results = list(drive(job, env, policy))
    except (PolicyError, ConfigError) as error:
        said = str(error).replace(job.policy, Path(job.policy).name)
        return Part(job.cell, job.first, refused=said)
    told = [
        episode_of(result, job.scenes.numbers[place], scoring)
        for result, place in zip(results, places, strict=True)
    ]
    return Part(job.cell, job.first, told, round(time.process_time() - begin, 3))


def _simulation(job: Job) -> str:
    """The simulation that a job needs; for the port one that checks whether the policy fits."""
    return PLANAR if job.cell.link == PORT else job.cell.link


def _simulated(job: Job, env: Any, policy: FilePolicy) -> Iterator[EpisodeResult]:
    """Drive in a simulation of this process."""
    for place in range(job.first, job.first + job.count):
        seed, options = job.scenes.reset(place)
        yield from evaluation.episodes(env, policy, 1, seed, **options)


@lru_cache(maxsize=1)
def _prepared(
    policy: str, env_id: str, link: str, condition: str, scenes: SceneSet
) -> tuple[Any, FilePolicy]:
    """Make an env and load its policy; kept for the next job of the same cell."""
    loaded = runs.load(policy, trust=False, env=env_id)
    config = CONDITIONS[condition].config
    options = CONDITIONS[condition].options(config)
    return runs.made(loaded, link, config, {"worlds": scenes.worlds, **options}), loaded

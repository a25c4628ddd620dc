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
from acsar_gym.benchmark.scenes import PUBLISHED, SceneSet
from acsar_gym.benchmark.store import Part
from acsar_gym.errors import PolicyError
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import runs
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.policies import FilePolicy
from acsar_gym.worlds.cache import keeping


def run(job: Job) -> Part:
    """Drive the scenes of a job.

    Args:
        job: what to drive.

    Returns:
        The episodes; or why the agent can't drive there at all, such as another observation.

    Raises:
        AcsarError: this time it can't be driven: a file, a package or a port is missing, ...
    """
    begin = time.process_time()
    if why := _impossible(job):
        return Part(job.cell, job.first, refused=why)
    policy = job.policy.load()
    try:
        env = _made(policy, _simulation(job), job.cell.condition, job.scenes)
    except PolicyError as error:
        own = Path(job.policy.name).name
        return Part(job.cell, job.first, refused=str(error).replace(str(policy.path), own))
    scoring = Scoring(
        job.cell.id, env.unwrapped.robot.config.max_linear, env.unwrapped.task.goal_tolerance
    )
    drive = port.results if job.cell.link == PORT else _simulated
    with keeping():
        results = list(drive(job, env, policy))
    places = range(job.first, job.first + job.count)
    told = [
        episode_of(result, job.scenes.numbers[place], scoring)
        for result, place in zip(results, places, strict=True)
    ]
    return Part(job.cell, job.first, told, round(time.process_time() - begin, 3))


def _impossible(job: Job) -> str:
    """Why the job's condition can't be had there, whoever drives; empty if it can."""
    return CONDITIONS[job.cell.condition].impossible(
        simulated=job.cell.link != PORT, published=job.scenes.name == PUBLISHED
    )


def _simulation(job: Job) -> str:
    """The simulation that a job needs; for the port one that checks whether the policy fits."""
    return PLANAR if job.cell.link == PORT else job.cell.link


def _simulated(job: Job, env: Any, policy: FilePolicy) -> Iterator[EpisodeResult]:
    """Drive in a simulation of this process."""
    for place in range(job.first, job.first + job.count):
        seed, options = job.scenes.reset(place)
        yield from evaluation.episodes(env, policy, 1, seed, **options)


@lru_cache(maxsize=1)
def _made(policy: FilePolicy, link: str, condition: str, scenes: SceneSet) -> Any:
    """Make an env for a policy; kept for the next job of the same cell."""
    config = CONDITIONS[condition].config
    options = CONDITIONS[condition].options(config, scenes.source)
    return runs.made(policy, link, config, {"worlds": scenes.worlds, **options})

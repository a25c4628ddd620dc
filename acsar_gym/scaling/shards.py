"""Evaluates a policy in parallel: the episodes are split into shards, which are jobs.

An episode depends on its seed alone, so the results are those of one process.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import runs
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.evaluation.results import Run
from acsar_gym.policies import FilePolicy
from acsar_gym.scaling.jobs import completed
from acsar_gym.scaling.sent import Sent
from acsar_gym.worlds import pool

LARGEST = 10
"""Most episodes of a shard; a dead process costs the time of one shard."""
PER_WORKER = 4
"""Shards per worker, at least, so that workers finish at about the same time."""
SIMULATED = ("bullet", "planar")


@dataclass(frozen=True)
class Shard:
    """Consecutive episodes of an evaluation; the fields are arguments of `runs.drive`."""

    policy: Sent
    link: str
    robot: RobotConfig = field(repr=False)
    seeds: range
    skip: int
    """Episodes of the evaluation before these."""
    how: Mapping[str, Any] = field(repr=False)
    options: Mapping[str, Any] = field(repr=False)


def run(shard: Shard) -> list[EpisodeResult]:
    """Run the episodes of a shard."""
    policy = shard.policy.load()
    with contextlib.closing(runs.made(policy, shard.link, shard.robot, dict(shard.options))) as env:
        return list(
            evaluation.episodes(
                env, policy, len(shard.seeds), shard.seeds.start, skip=shard.skip, **shard.how
            )
        )


def drive(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    seeds: range,
    *,
    how: Mapping[str, Any] | None = None,
    workers: int | None = None,
    address: str | None = None,
    **options: Any,
) -> Run:
    """Evaluate a policy as `runs.drive`, in parallel.

    Args:
        policy: the policy.
        link: name of the link; more than one worker need a simulated one.
        robot: preset or file of the robot; None for the default.
        seeds: seeds of the episodes.
        how: keyword arguments of `episodes.episodes`.
        workers: as for `completed`.
        address: as for `completed`.
        **options: other arguments of the env.

    Raises:
        ConfigError: the link or the recording can't be used by several processes.
        AcsarError: see `runs.drive` and `completed`.
    """
    if address is None and workers in (None, 1):
        return runs.drive(policy, link, robot, seeds, how=how, **options)
    _check(link, options)
    config, portable = RobotConfig.of(robot), _portable(options)
    whole = Shard(Sent.of(policy), link, config, seeds, 0, how or {}, portable)
    finished = completed(run, _split(whole, workers), workers=workers, address=address)
    with contextlib.closing(finished):
        results = (result for _, shard in finished for result in shard)
        done = runs.drive(policy, link, robot, seeds, how=how, elsewhere=results, **options)
    done.results.sort(key=lambda result: seeds.index(result.seed or 0))
    done.header.update(workers=workers, address=address)
    return done


def _check(link: str, options: Mapping[str, Any]) -> None:
    """Check that several processes can drive at once."""
    if link not in SIMULATED:
        raise ConfigError(
            f"--link {shown(link)}: one process drives one robot: --workers and --address need "
            f"--link {' or '.join(SIMULATED)}"
        )
    if options.get("record") is not None:
        raise ConfigError("--record and --view: one process records: leave out --workers")


def _portable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Read worlds from files, which another machine may not have."""
    source = options.get("worlds")
    read = pool.read(source) if isinstance(source, str) else None
    return dict(options) if read is None else {**options, "worlds": read}


def _split(whole: Shard, workers: int | None) -> list[Shard]:
    """Split an evaluation into jobs."""
    first = whole.seeds.start
    return [
        replace(whole, seeds=part, skip=part.start - first) for part in parts(whole.seeds, workers)
    ]


def parts(seeds: range, workers: int | None) -> list[range]:
    """Split the seeds into shards."""
    size = len(seeds) // (PER_WORKER * workers) if workers else LARGEST
    size = max(1, min(LARGEST, size))
    return [seeds[first : first + size] for first in range(0, len(seeds), size)]

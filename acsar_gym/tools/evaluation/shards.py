"""Evaluates a policy in parallel: the episodes are split into shards, which are jobs.

An episode depends on its seed alone, so the results are those of one process.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, PolicyError, show_value
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.evaluation.runs import EvaluationRun
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy, ZipPolicy
from acsar_gym.worlds import pool
from acsar_gym.worlds.search import lidar_height

MAX_POLICY_BYTES = 200_000_000
MAX_SHARD_EPISODES = 10
"""Most episodes of a shard; a dead process costs the time of one shard."""
SHARDS_PER_WORKER = 4
"""Shards per worker, at least, so that workers finish at about the same time."""


@dataclass(frozen=True)
class PortablePolicy:
    """A loaded policy, ready to be loaded again in other processes and on other machines."""

    name: str
    """Its path or name."""
    env: str
    """Id of the env that it was loaded for; empty for the one that its file names."""
    function: str | None = field(repr=False)
    trust: bool = field(repr=False)
    sha256: str | None = field(repr=False)
    content: bytes | None = field(repr=False)
    """Content of its file; None for a policy that isn't a file."""
    given: Any = field(default=None, repr=False, compare=False)
    """The policy itself, if it is an object in Python."""

    @classmethod
    def of(cls, policy: FilePolicy) -> PortablePolicy:
        """Read the file of a policy.

        Args:
            policy: the policy; a zip that is loaded already is trusted.

        Raises:
            PolicyError: its file has changed since it was loaded.
        """
        env = policy.env_id if policy.env_named else ""
        content = None
        if policy.path.is_file():
            content = reading.read_file(policy.path, MAX_POLICY_BYTES, PolicyError)
            if policy.sha256 not in (None, hashlib.sha256(content).hexdigest()):
                raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
        trust = isinstance(policy, ZipPolicy)
        own = None if policy.given is None else policy
        return cls(str(policy.path), env, policy.function, trust, policy.sha256, content, own)

    def load(self) -> FilePolicy:
        """Load the policy: from its file if that is the same here, else from the content.

        Raises:
            PolicyError: it can't be loaded here.
        """
        return _load_portable(self) if self.given is None else self.given


@lru_cache(maxsize=4)
def _load_portable(sent: PortablePolicy) -> FilePolicy:
    """Load a policy; a process needs few of them, but each for many jobs."""
    suffix = f":{sent.function}" if sent.function else ""
    here = None
    with contextlib.suppress(OSError):
        here = None if sent.content is None else Path(sent.name).read_bytes()
    if here == sent.content:
        return runs.load_policy(f"{sent.name}{suffix}", trust=sent.trust, env=sent.env)
    with tempfile.TemporaryDirectory(prefix="acsar_gym-") as folder:
        copy = Path(folder) / Path(sent.name).name
        copy.write_bytes(sent.content or b"")
        return runs.load_policy(f"{copy}{suffix}", trust=sent.trust, env=sent.env)


@dataclass(frozen=True)
class Shard:
    """Consecutive episodes of an evaluation; the fields are arguments of `evaluate_policy`."""

    policy: PortablePolicy
    link: str
    robot: RobotConfig = field(repr=False)
    seeds: range
    skip: int
    """Episodes of the evaluation before these."""
    how: Mapping[str, Any] = field(repr=False)
    options: Mapping[str, Any] = field(repr=False)


def run_shard(shard: Shard) -> list[EpisodeResult]:
    """Run the episodes of a shard."""
    policy, seeds = shard.policy.load(), shard.seeds
    env = runs.make_env(policy, shard.link, shard.robot, shard.options)
    with contextlib.closing(env):
        return list(
            evaluation.run_episodes(
                env, policy, len(seeds), seeds.start, skip=shard.skip, **shard.how
            )
        )


def evaluate_in_parallel(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    seeds: range,
    *,
    how: Mapping[str, Any] | None = None,
    workers: int | None = None,
    address: str | None = None,
    **options: Any,
) -> EvaluationRun:
    """Evaluate a policy as `runs.evaluate_policy`, in parallel.

    Args:
        policy: the policy.
        link: name of the link; more than one worker need a simulated one.
        robot: preset or file of the robot; None for the default.
        seeds: seeds of the episodes.
        how: keyword arguments of `episodes.run_episodes`.
        workers: as for `completed`.
        address: as for `completed`.
        **options: other arguments of the env.

    Raises:
        ConfigError: the link or the recording can't be used by several processes.
        AcsarError: see `runs.evaluate_policy` and `completed`.
    """
    if address is None and workers in (None, 1):
        return runs.evaluate_policy(policy, link, robot, seeds, how=how, **options)
    if link not in BODIES:
        raise ConfigError(
            f"--link {show_value(link)}: one process drives one robot: --workers and --address "
            f"need --link {' or '.join(BODIES)}"
        )
    if options.get("record") is not None:
        raise ConfigError("--record and --view: one process records: leave out --workers")
    source, portable = options.get("worlds"), dict(options)
    sent, config = PortablePolicy.of(policy), RobotConfig.of(robot)
    worlds = None
    if isinstance(source, str | Mapping):
        worlds = pool.read_worlds(source, lidar_height(config))
    if worlds is not None:  # from files, which another machine may not have
        portable["worlds"] = worlds
    shards = [
        Shard(sent, link, config, part, part.start - seeds.start, how or {}, portable)
        for part in split_seeds(seeds, workers)
    ]
    finished = completed(run_shard, shards, workers=workers, address=address)
    with contextlib.closing(finished):
        results = (result for _, shard in finished for result in shard)
        done = runs.evaluate_policy(
            policy, link, robot, seeds, how=how, elsewhere=results, **options
        )
    done.results.sort(key=lambda result: seeds.index(result.seed or 0))
    done.header.update(workers=workers, address=address)
    return done


def split_seeds(seeds: range, workers: int | None) -> list[range]:
    """Split the seeds into shards."""
    size = len(seeds) // (SHARDS_PER_WORKER * workers) if workers else MAX_SHARD_EPISODES
    size = max(1, min(MAX_SHARD_EPISODES, size))
    return [seeds[first : first + size] for first in range(0, len(seeds), size)]

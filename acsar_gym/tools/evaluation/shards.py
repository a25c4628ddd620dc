"""Evaluates a policy in parallel: the episodes are split into shards, which are jobs."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, PolicyError, show_value
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.evaluation.runs import EvaluationRun
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy, ZipPolicy
from acsar_gym.worlds import pool

MAX_POLICY_BYTES = 200_000_000


@dataclass(frozen=True)
class PortablePolicy:
    """A loaded policy, ready to be loaded again elsewhere."""

    name: str
    """Its path or name."""
    env: str
    """Id of the env that it was loaded for; empty for the one that its file names."""
    function: str | None = field(repr=False)
    trust: bool = field(repr=False)
    sha256: str | None = field(repr=False)
    content: bytes | None = field(repr=False)
    """Content of its file; None for a policy that isn't a file."""

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
            if policy.sha256 not in (None, _hash(content)):
                raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
        trust = isinstance(policy, ZipPolicy)
        return cls(str(policy.path), env, policy.function, trust, policy.sha256, content)

    def load(self) -> FilePolicy:
        """Load the policy: from its file if that is the same here, else from the content.

        Raises:
            PolicyError: it can't be loaded here.
        """
        return _loaded(self)


@lru_cache(maxsize=4)
def _loaded(sent: PortablePolicy) -> FilePolicy:
    """Load a policy; a process needs few of them, but each for many jobs."""
    if sent.content is None or _same(sent):
        return _load(sent, sent.name)
    with tempfile.TemporaryDirectory(prefix="acsar_gym-") as folder:
        copy = Path(folder) / Path(sent.name).name
        copy.write_bytes(sent.content)
        return _load(sent, str(copy))


def _load(sent: PortablePolicy, path: str) -> FilePolicy:
    """Load a policy from a path or by its name."""
    name = f"{path}:{sent.function}" if sent.function else path
    return runs.load_policy(name, trust=sent.trust, env=sent.env)


def _same(sent: PortablePolicy) -> bool:
    """Whether the file here has the content that was sent."""
    with contextlib.suppress(OSError):
        return _hash(Path(sent.name).read_bytes()) == _hash(sent.content or b"")
    return False


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


MAX_SHARD_EPISODES = 10
"""Most episodes of a shard; a dead process costs the time of one shard."""
SHARDS_PER_WORKER = 4
"""Shards per worker, at least, so that workers finish at about the same time."""
SIMULATED_LINKS = ("bullet", "planar")


@dataclass(frozen=True)
class Shard:
    """Consecutive episodes of an evaluation; the fields are arguments of `runs.drive`."""

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
    policy = shard.policy.load()
    with contextlib.closing(
        runs.make_env(policy, shard.link, shard.robot, dict(shard.options))
    ) as env:
        return list(
            evaluation.run_episodes(
                env, policy, len(shard.seeds), shard.seeds.start, skip=shard.skip, **shard.how
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
        return runs.evaluate_policy(policy, link, robot, seeds, how=how, **options)
    _check(link, options)
    config, portable = RobotConfig.of(robot), _portable(options)
    whole = Shard(PortablePolicy.of(policy), link, config, seeds, 0, how or {}, portable)
    finished = completed(run_shard, _split(whole, workers), workers=workers, address=address)
    with contextlib.closing(finished):
        results = (result for _, shard in finished for result in shard)
        done = runs.evaluate_policy(
            policy, link, robot, seeds, how=how, elsewhere=results, **options
        )
    done.results.sort(key=lambda result: seeds.index(result.seed or 0))
    done.header.update(workers=workers, address=address)
    return done


def _check(link: str, options: Mapping[str, Any]) -> None:
    """Check that several processes can drive at once."""
    if link not in SIMULATED_LINKS:
        raise ConfigError(
            f"--link {show_value(link)}: one process drives one robot: --workers and "
            "--address need "
            f"--link {' or '.join(SIMULATED_LINKS)}"
        )
    if options.get("record") is not None:
        raise ConfigError("--record and --view: one process records: leave out --workers")


def _portable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Read worlds from files, which another machine may not have."""
    source = options.get("worlds")
    read = pool.read_worlds(source) if isinstance(source, str) else None
    return dict(options) if read is None else {**options, "worlds": read}


def _split(whole: Shard, workers: int | None) -> list[Shard]:
    """Split an evaluation into jobs."""
    first = whole.seeds.start
    return [
        replace(whole, seeds=part, skip=part.start - first)
        for part in split_seeds(whole.seeds, workers)
    ]


def split_seeds(seeds: range, workers: int | None) -> list[range]:
    """Split the seeds into shards."""
    size = len(seeds) // (SHARDS_PER_WORKER * workers) if workers else MAX_SHARD_EPISODES
    size = max(1, min(MAX_SHARD_EPISODES, size))
    return [seeds[first : first + size] for first in range(0, len(seeds), size)]

"""Loads policies, makes their envs, and evaluates them: `evaluate`, `run` and `export`."""

from __future__ import annotations

import contextlib
import hashlib
import math
import tempfile
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from acsar_gym import reading
from acsar_gym.config import RobotConfig, RobotSource
from acsar_gym.envs.ids import find_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import (
    AcsarError,
    AcsarWarning,
    ConfigError,
    EmergencyStopError,
    LinkError,
    PolicyError,
    escape_unprintable,
    format_error,
    require_extra,
    show_value,
)
from acsar_gym.links import Link, open_link
from acsar_gym.links.factory import is_device
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools import baselines
from acsar_gym.tools.evaluation import episodes, metrics, provenance, report
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import Summary
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import (
    CallablePolicy,
    FilePolicy,
    OnnxPolicy,
    ZipPolicy,
    is_callable,
    resolve,
    statistics_beside,
)
from acsar_gym.tools.policies.bundle import RETRAIN_HINT, describe_policy, env_policy_rate
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.worlds import registry
from acsar_gym.worlds.search import lidar_height
from acsar_gym.worlds.sets import name_alone, parse_sets

Env = gymnasium.Env[Any, Any]
MAX_EPISODES = 10**6  # most episodes of one evaluation; all results are kept in memory
SEED_LIMIT = 2**63  # the first seed must be below this
MAX_POLICY_BYTES = 200_000_000
MAX_SHARD_EPISODES, MAX_BATCHED_EPISODES = 10, 250
"""Most episodes of a shard: driven one by one, and as a batch."""
SHARDS_PER_WORKER = 4  # shards per worker, at least, so that workers finish at about the same time


@dataclass(frozen=True)
class EvaluationRun:
    """Results of an evaluation, complete or ended early, and what it was run with."""

    header: dict[str, Any]  # what is needed to repeat it; see `provenance`
    worlds: str  # description of the worlds, such as "clutter 0 to 199 (test split)" or "none"
    results: list[Episode]
    ended: LinkError | KeyboardInterrupt | None = None
    """What ended it before its last episode; None for an evaluation that is complete."""

    @property
    def faults(self) -> list[str]:
        """The faults that ended episodes."""
        return [episode.fault for episode in self.results if episode.fault]

    @property
    def late(self) -> int:
        """Number of episodes with too many late ticks."""
        return sum(not episode.valid and not episode.fault for episode in self.results)

    @property
    def ended_early(self) -> str | None:
        """Why it ended before its last episode."""
        return None if self.ended is None else str(self.ended) or "interrupted"

    @property
    def notes(self) -> list[str]:
        """Faults, and an end before the last episode, as lines for people."""
        notes = []
        if self.header["policy"]["privileged"]:
            notes.append("It knows what only a simulator does: no robot can do the same.")
        if self.faults:
            notes.append(f"Faults: {len(self.faults)} of {len(self.results)}: {self.faults[0]}")
        if self.ended is not None:
            seeds = self.header["seeds"]
            count = seeds["last"] - seeds["first"] + 1
            notes.append(
                f"Ended after {len(self.results)} of {count} episodes: {self.ended_early}."
            )
        return notes

    @cached_property
    def summary(self) -> Summary:
        """Rates and means over the episodes."""
        return metrics.summarise_episodes(self.results)

    def as_dict(self) -> dict[str, Any]:
        """Return header, means and every episode, for JSON."""
        return {
            "header": self.header,
            **self.summary.as_dict(),
            "ended_early": self.ended_early,
            "per_episode": metrics.describe_episodes(self.results),
        }


def load_policy(policy: Any, *, trust: bool, env: str = "") -> FilePolicy:
    """Load a policy: a file, a packaged one, a baseline, or Python code such as "mine.py:act".

    Args:
        policy: its path or name; files come first, then packaged policies, then baselines. Or a
            function or class of a module, as in "mine.module:Planner", or an object; see
            `CallablePolicy`.
        trust: whether it may be a stable-baselines3 zip, which can run code when it is loaded.
        env: id or short name of the env that it is for; by default the one that the file names.

    Raises:
        PolicyError: there is no such policy, or it is a zip without `trust`, or a zip beside a
            saved VecNormalize, which must be converted with `export` first.
        ConfigError: there is no such `env`.
    """
    env_id = find_id(env) if env else ""
    if isinstance(policy, FilePolicy):
        if env_id:
            policy.env_id, policy.env_named = env_id, True
        if not policy.path.is_file():
            policy.given = policy
        return policy
    if is_callable(policy):
        return CallablePolicy(policy, env_id)
    if baselines.is_baseline(policy):
        return baselines.load_baseline(policy, env_id)
    path = resolve(policy, baselines.BASELINES)
    if path.suffix == ".zip":
        loaded = ZipPolicy(path, trust=trust, env_id=env_id)
        _find_statistics(loaded, None)
        return loaded
    file = OnnxPolicy(path)
    file.env_id, file.env_named = env_id or file.env_id, bool(env_id)
    return file


def make_env(policy: FilePolicy, link: str | Link, robot: Any, options: Mapping[str, Any]) -> Env:
    """Make the env that a policy was trained for, and check that it gives the same observation.

    Args:
        policy: the policy. Only the user, not the file, may name an env of another package.
        link: name of the link, or an open link.
        robot: preset, file or config of the robot.
        options: other arguments of the env; None means the env's default. Worlds such as
            "clutter", and those of an env that trains in a training split, become their test split;
            "clutter:train" means the training split.

    Raises:
        PolicyError: no env is named, it can't be made, its observation is another one, or a real
            robot isn't one of those that the policy is for.
        ConfigError: the env doesn't have one of the arguments.
    """
    env_id = _check_id(policy)
    given = {name: value for name, value in options.items() if value is not None}
    given = {"link": link, "robot": robot, **given}
    if "worlds" in given:
        given["worlds"] = name_alone(given["worlds"], registry.TEST)
    try:
        env = gymnasium.make(env_id, **given)
        pool = getattr(env.unwrapped, "pool", None)
        if "worlds" not in given and pool is not None and pool.split == registry.TRAIN:
            env.close()
            tested = [f"{group.generator}:{registry.TEST}" for group in pool.sets]
            env = gymnasium.make(env_id, **given, worlds=tested if tested[1:] else tested[0])
    except (gymnasium.error.Error, ImportError) as error:
        raise PolicyError(f"{policy.path}: made for {env_id}: {error}") from error
    except TypeError as error:
        names = ", ".join(given)
        raise ConfigError(
            f"{env_id} doesn't take all of: {names} ({format_error(error)})"
        ) from error
    inner = env.unwrapped
    try:
        if isinstance(inner, RobotEnv):
            policy.check(inner.task, inner.sensors, env_policy_rate(inner), inner.robot.config)
            if inner.robot.link.truth is None:  # on hardware
                refuse_outside(policy)
            policy.bind(PolicyContext.of(inner))
            if policy.privileged:
                policy.watch(inner)
    except BaseException:
        env.close()
        raise
    return env


def _check_id(policy: FilePolicy) -> str:
    """Return the id of the env that a policy is for; PolicyError if it may not name it."""
    env_id = escape_unprintable(policy.env_id, 300)
    if not env_id:
        raise PolicyError(
            f"{policy.path}: doesn't say which environment it is for: convert it with "
            f"'acsar-gym export {policy.path} policy.onnx --trust --env point_goal' or another env"
        )
    if not policy.env_named and not env_id.startswith("acsar_gym/"):
        raise PolicyError(
            f"{policy.path}: made for {env_id}, which isn't acsar_gym's: if you trust that "
            "package, name it with --env"
        )
    try:
        return find_id(env_id)
    except ConfigError as error:
        raise PolicyError(f"{policy.path}: {error}") from error


def seed_range(first: int, count: int) -> range:
    """Return the seeds of `count` episodes from `first` on; ConfigError if out of range."""
    if not 1 <= count <= MAX_EPISODES:
        raise ConfigError(f"--episodes {show_value(count)}: must be 1 to {MAX_EPISODES:,}")
    if not 0 <= first < SEED_LIMIT:
        raise ConfigError(f"--seed {show_value(first)}: must be 0 to 2^63 - 1")
    return range(first, first + count)


@dataclass(frozen=True)
class PortablePolicy:
    """A loaded policy, ready to be loaded again in other processes and on other machines."""

    name: str  # its path or name
    env: str  # id of the env that it was loaded for; empty for the one that its file names
    function: str | None = field(repr=False)
    trust: bool = field(repr=False)
    content: bytes | None = field(repr=False)
    """Content of its file; None for a policy that isn't a file."""
    given: Any = field(default=None, repr=False, compare=False)
    """The policy itself, if it is an object in Python."""

    @classmethod
    def of(cls, policy: FilePolicy) -> PortablePolicy:
        """Read the file of a policy; a zip that is loaded already is trusted.

        Raises:
            PolicyError: its file has changed since it was loaded.
        """
        content = None
        if policy.path.is_file():
            content = reading.read_file(policy.path, MAX_POLICY_BYTES, PolicyError)
            if policy.sha256 not in (None, hashlib.sha256(content).hexdigest()):
                raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
        return cls(
            str(policy.path),
            policy.env_id if policy.env_named else "",
            policy.function,
            isinstance(policy, ZipPolicy),
            content,
            None if policy.given is None else policy,
        )

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
        return load_policy(f"{sent.name}{suffix}", trust=sent.trust, env=sent.env)
    with tempfile.TemporaryDirectory(prefix="acsar_gym-") as folder:
        sent_file = Path(folder) / Path(sent.name).name
        sent_file.write_bytes(sent.content or b"")
        return load_policy(f"{sent_file}{suffix}", trust=sent.trust, env=sent.env)


@dataclass(frozen=True)
class Shard:
    """Consecutive episodes of an evaluation, for one process."""

    policy: PortablePolicy
    link: str
    robot: RobotConfig = field(repr=False)
    seeds: range
    skip: int  # episodes of the evaluation before these
    how: Mapping[str, Any] = field(repr=False)
    options: Mapping[str, Any] = field(repr=False)


def run_shard(shard: Shard) -> list[Episode]:
    """Run the episodes of a shard."""
    policy, seeds = shard.policy.load(), shard.seeds
    with contextlib.closing(make_env(policy, shard.link, shard.robot, shard.options)) as env:
        return list(
            episodes.run_episodes(
                env, policy, len(seeds), seeds.start, skip=shard.skip, **shard.how
            )
        )


def evaluate_policy(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    seeds: range,
    *,
    how: Mapping[str, Any] | None = None,
    workers: int | None = None,
    address: str | None = None,
    **options: Any,
) -> EvaluationRun:
    """Evaluate a policy in worlds of the test split, with a progress bar; closes the link.

    An emergency stop, an interrupt, and a link that can't be opened again end it after an episode;
    the finished episodes are kept. An episode depends on its seed alone, so in several processes
    the results are those of one.

    Args:
        policy: the policy.
        link: name of the link; more than one worker need a simulated one.
        robot: preset, file or config of the robot; None for the default.
        seeds: seeds of the episodes.
        how: keyword arguments of `episodes.run_episodes`.
        workers: as for `jobs.completed`.
        address: as for `jobs.completed`.
        **options: other arguments of the env.
    """
    with require_extra("an evaluation", "scipy"):  # before the first episode, not after the last
        import scipy  # noqa: F401, PLC0415
    how = how or {}
    if address is None and workers in (None, 1):
        compile_ahead(policy, link, RobotConfig.of(robot))
        env = make_env(policy, link, robot, options)
        running = episodes.run_episodes(env, policy, len(seeds), seeds.start, **how)
    else:
        shards = _split_evaluation(policy, link, robot, seeds, how, workers, options)
        env = make_env(policy, link, robot, options)
        running = _run_shards(shards, workers, address)
    _warn_differences(policy)
    with contextlib.closing(running):
        watched = report.watch_progress(
            f"episodes, {report.escape_text(link)}", running, len(seeds)
        )
        done = _collect_run(env, policy, link, seeds, how, watched)
    done.results.sort(key=lambda episode: seeds.index(episode.seed or 0))
    done.header.update(workers=workers if address else workers or 1, address=address)
    return done


def _run_shards(
    shards: list[Shard], workers: int | None, address: str | None
) -> Generator[Episode, None, None]:
    """Yield the episodes of shards that run in parallel."""
    finished = completed(run_shard, shards, workers=workers, address=address)
    with contextlib.closing(finished):
        for _, driven in finished:
            yield from driven


def _split_evaluation(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    seeds: range,
    how: Mapping[str, Any],
    workers: int | None,
    options: Mapping[str, Any],
) -> list[Shard]:
    """Split an evaluation into shards."""
    if link not in BODIES:
        raise ConfigError(
            f"--link {show_value(link)}: one process drives one robot: --workers and --address "
            f"need --link {' or '.join(BODIES)}"
        )
    if options.get("record") is not None:
        raise ConfigError("--record: one process records: leave out --workers")
    portable, config, source = dict(options), RobotConfig.of(robot), options.get("worlds")
    if source is not None:
        sets = parse_sets(source, alone=registry.TEST, height=lidar_height(config))
        if any(group.worlds for group in sets):  # from files, which another machine may not have
            portable["worlds"] = sets
    batched = link == "planar" and policy.act_many is not None
    most = MAX_BATCHED_EPISODES if batched else MAX_SHARD_EPISODES
    size = len(seeds) // (SHARDS_PER_WORKER * workers) if workers else most
    size = max(1, min(most, size))
    parts = [seeds[first : first + size] for first in range(0, len(seeds), size)]
    sent = PortablePolicy.of(policy)
    return [
        Shard(sent, link, config, part, part.start - seeds.start, how, portable) for part in parts
    ]


def drive_to_goal(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    goal: tuple[float, float],
    ready: Callable[[], object] = lambda: None,
    how: Mapping[str, Any] = {},
    **options: Any,
) -> EvaluationRun:
    """Run one episode to `goal` (x, y) [m] in the odometry frame; arguments as `evaluate_policy`.

    `ready` is called before anything moves, when all that can be known of the policy is told. With
    `goal_distance`, goals may be nearer or farther than those of the training; the time limit grows
    with the distance.
    """

    def drive(env: Env) -> Iterator[Episode]:
        ready()
        return episodes.run_episodes(env, policy, 1, seed=0, goal=goal, **how)

    about, farthest = {"goal": goal, **how}, math.hypot(*goal)
    return drive_to_goals(policy, link, robot, drive, farthest, about, range(1), **options)


def compile_ahead(policy: FilePolicy, link: str, config: RobotConfig) -> None:
    """Step a simulated robot before a real one waits: compiling may take a quarter of a minute."""
    if not is_device(link):
        return
    for robot in (config, None):  # one that can't be simulated compiles like any other
        with contextlib.suppress(AcsarError):
            with contextlib.closing(make_env(policy, "planar", robot, {})) as env:
                env.reset(seed=0)
                env.step(np.zeros(env.action_space.shape or (), np.float32))
            return


def drive_to_goals(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    drive: Callable[[Env], Iterable[Episode]],
    farthest: float,
    about: Mapping[str, Any],
    seeds: range | None = None,
    **options: Any,
) -> EvaluationRun:
    """Run the episodes that `drive` yields with an env of a policy; closes the link.

    Args:
        policy: the policy; refused where it isn't for this robot.
        link: name of the link.
        robot: preset, file or config of the robot; None for the default.
        drive: makes the episodes.
        farthest: distance of the farthest goal [m]; where there is `goal_distance`, the time limit
            grows with it.
        about: what the header tells about the episodes.
        seeds: of the episodes; None: they count up from 0.
        **options: other arguments of the env.
    """
    if options.get("goal_distance") is not None and policy.scale:
        options["distance_scale"] = policy.scale
        steps = gymnasium.spec(_check_id(policy)).max_episode_steps
        if steps is not None:
            longer = max(1.0, farthest / policy.scale)
            options["max_episode_steps"] = math.ceil(steps * longer)
    config = RobotConfig.of(robot)
    compile_ahead(policy, link, config)
    env = make_env(policy, open_link(link, config), config, options)
    with contextlib.closing(env):
        refuse_outside(policy)
        _warn_differences(policy)
        return _collect_run(env, policy, link, seeds, about, drive(env))


def _warn_differences(policy: FilePolicy) -> None:
    """Issue an AcsarWarning for each way in which the robot differs from those of the training."""
    for line in (*policy.outside, *policy.differences):
        warnings.warn(f"{policy.path}: {line}", AcsarWarning, stacklevel=3)


def refuse_outside(policy: FilePolicy) -> None:
    """Raise PolicyError where the robot isn't one of those that the policy is for."""
    if policy.outside:
        raise PolicyError(f"{policy.path}: {'; '.join(policy.outside)}: {RETRAIN_HINT}")


def _collect_run(
    env: Env,
    policy: FilePolicy,
    link: str,
    seeds: range | None,
    options: Mapping[str, Any],
    running: Iterable[Episode],
) -> EvaluationRun:
    """Collect episodes, with what ended them early, and the header; closes the env.

    Without `seeds`, they count up from 0. A link's error before the first result is raised, unless
    it is an emergency stop.
    """
    driven: list[Episode] = []
    ended: LinkError | KeyboardInterrupt | None = None
    try:
        for episode in running:
            driven.append(episode)  # noqa: PERF402 - what is there counts where the rest fails
    except (EmergencyStopError, KeyboardInterrupt) as error:
        ended = error
    except LinkError as error:
        if not driven:
            raise
        ended = error
    finally:
        env.close()  # before the files are hashed
    inner: Any = env.unwrapped
    seeds = range(max(len(driven), 1)) if seeds is None else seeds
    header = provenance.make_header(env, policy, link, seeds, options)
    return EvaluationRun(header, describe_worlds(inner), driven, ended)


def describe_worlds(env: RobotEnv) -> str:
    """Describe the worlds of an env. A real robot is in none of them."""
    link = env.robot.link
    is_placed = not link.is_real or (link.ros is not None and link.ros.is_simulated)
    return str(env.pool) if env.pool is not None and is_placed else "none"


def export_policy(
    model: Path,
    out: Path,
    env_id: str,
    robot: str | None,
    *,
    trust: bool,
    vecnormalize: str | None = None,
) -> None:
    """Convert a stable-baselines3 zip to an ONNX policy."""
    if resolve(model).suffix == ".onnx":
        raise PolicyError(
            f"{model}: is an ONNX policy already: drive with it, as in 'acsar-gym evaluate "
            f"--policy {model}'; 'export' converts zips of stable-baselines3"
        )
    policy = ZipPolicy(model, trust=trust, env_id=find_id(env_id) if env_id else "")
    statistics = _find_statistics(policy, vecnormalize)
    env = make_env(policy, "planar", robot, {})
    from acsar_gym.tools.policies import sb3  # noqa: PLC0415 - optional

    inner: Any = env.unwrapped
    try:
        known = policy.bundle
        if known is None or known.env.id != strip_module(policy.env_id):
            known = describe_policy(inner, policy.env_id)
        before = None
        if statistics is not None:
            width = known.observation.width
            before = sb3.read_normalizer(statistics, width, policy.frames)
        sb3.export_policy(policy.network, out, known, before)
    finally:
        env.close()


def _find_statistics(policy: ZipPolicy, named: str | None) -> Path | None:
    """Return the VecNormalize file to use.

    PolicyError if none is named, but one lies beside the zip, or the model was trained with one.
    """
    if named is not None:
        return None if named == "none" else Path(named)
    model, found = policy.path, statistics_beside(policy.path)
    convert = f"'acsar-gym export {model} policy.onnx --trust --vecnormalize"
    if found is not None:
        raise PolicyError(
            f"{model}: {found} is beside it: if it was trained with that VecNormalize, use "
            f"{convert} {found}', otherwise --vecnormalize none"
        )
    if policy.normalized:
        raise PolicyError(
            f"{model}: was trained with a VecNormalize, whose file isn't beside it: use {convert} "
            "FILE' with the file that it was saved to, or --vecnormalize none if it changed only "
            "rewards"
        )
    return None

"""Loads policies, makes their envs, and evaluates them: `evaluate` and `run`."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import gymnasium
import numpy as np

from acsar_gym.config import RobotConfig, RobotSource
from acsar_gym.envs.ids import find_id
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
from acsar_gym.tools.evaluation.episode import Episode, Resets
from acsar_gym.tools.evaluation.metrics import Summary
from acsar_gym.tools.jobs import run_jobs
from acsar_gym.tools.policies import (
    CallablePolicy,
    FilePolicy,
    OnnxPolicy,
    ZipPolicy,
    is_callable,
    resolve,
)
from acsar_gym.tools.policies.document import RETRAIN_HINT, env_policy_rate
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.worlds import registry
from acsar_gym.worlds.sets import name_alone

Env = gymnasium.Env[Any, Any]
MAX_EPISODES = 10**6
"""Most episodes of one evaluation: all results are kept in memory."""
SEED_LIMIT = 2**63
"""The first seed must be below this."""
MAX_PART_EPISODES = 10
"""Most episodes of a job that are driven one by one."""
MAX_BATCHED_EPISODES = 250
"""Most episodes of a job that are driven as a batch."""
PARTS_PER_WORKER = 4
"""Jobs of each worker, at least, so that workers finish at about the same time."""


@dataclass(frozen=True)
class EvaluationRun:
    """Results of an evaluation, complete or ended early, and what it was run with."""

    header: dict[str, Any]
    """What is needed to repeat it, see `provenance`."""
    worlds: str
    """Description of the worlds, such as "clutter 0 to 199 (test split)" or "none"."""
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
        PolicyError: there is no such policy, or it is a zip without `trust`.
        ConfigError: there is no such `env`.
    """
    env_id = find_id(env) if env else ""
    if isinstance(policy, FilePolicy):
        if env_id:
            policy.env_id = env_id
            policy.env_named = True
        if not policy.path.is_file():
            policy.instance = policy
        return policy
    if is_callable(policy):
        return CallablePolicy(policy, env_id)
    if baselines.is_baseline(policy):
        return baselines.load_baseline(policy, env_id)

    path = resolve(policy, baselines.BASELINES)
    if path.suffix == ".zip":
        return ZipPolicy(path, trust=trust, env_id=env_id)
    file = OnnxPolicy(path)
    file.env_id = env_id or file.env_id
    file.env_named = bool(env_id)
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
    kwargs: dict[str, Any] = {"link": link, "robot": robot}
    kwargs |= {name: value for name, value in options.items() if value is not None}
    if "worlds" in kwargs:
        kwargs["worlds"] = name_alone(kwargs["worlds"], registry.TEST)
    try:
        env = gymnasium.make(env_id, **kwargs)
        pool = getattr(env.unwrapped, "pool", None)
        if "worlds" not in kwargs and pool is not None and pool.split == registry.TRAIN:
            env.close()
            tested = [f"{group.generator}:{registry.TEST}" for group in pool.sets]
            env = gymnasium.make(env_id, **kwargs, worlds=tested if tested[1:] else tested[0])
    except (gymnasium.error.Error, ImportError) as error:
        raise PolicyError(f"{policy.path}: made for {env_id}: {error}") from error
    except TypeError as error:
        names = ", ".join(kwargs)
        raise ConfigError(
            f"{env_id} doesn't take all of: {names} ({format_error(error)})"
        ) from error

    inner = env.unwrapped
    try:
        if isinstance(inner, RobotEnv):
            policy.check(inner.task, inner.sensors, env_policy_rate(inner), inner.robot.config)
            if inner.robot.link.is_real:
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
            f"'acsar-gym policy {policy.path} --out policy.onnx --trust --env point_goal' or "
            "another env"
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
class SentPolicy:
    """A policy on its way to another process: itself, or the name of Python code to load there."""

    policy: FilePolicy | str
    env: str = ""
    sha256: str | None = None

    @classmethod
    def of(cls, policy: FilePolicy) -> SentPolicy:
        """Return how a policy is sent: code by its name, others with their bytes."""
        if policy.instance is not None or not isinstance(policy, CallablePolicy):
            return cls(policy)
        name = f"{policy.path}:{policy.function}" if policy.function else str(policy.path)
        return cls(name, policy.env_id, policy.sha256)

    def load(self) -> FilePolicy:
        """Return the policy; PolicyError if its file has changed since it was loaded first."""
        return self.policy if isinstance(self.policy, FilePolicy) else _load_code(self)


@lru_cache(maxsize=4)
def _load_code(sent: SentPolicy) -> FilePolicy:
    """Load code once in a process, for many jobs."""
    policy = load_policy(sent.policy, trust=False, env=sent.env)
    if policy.sha256 != sent.sha256:
        raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
    return policy


@dataclass(frozen=True)
class EpisodeJob:
    """Episodes of a policy, for one process."""

    policy: SentPolicy
    link: str
    robot: RobotConfig = field(repr=False)
    options: Mapping[str, Any] = field(repr=False)
    """Other arguments of the env."""
    resets: Resets
    late_share: float = episodes.MAX_LATE_SHARE

    def make_env(self) -> Env:
        """Make the env of the episodes, and check that the policy fits; see `make_env`."""
        return make_env(self.policy.load(), self.link, self.robot, self.options)

    def drive(self, env: Env) -> Generator[Episode, None, None]:
        """Drive the episodes, and yield each."""
        return episodes.run_resets(env, self.policy.load(), self.resets, self.late_share)


def run_job(job: EpisodeJob) -> list[Episode]:
    """Run the episodes of a job."""
    with contextlib.closing(job.make_env()) as env:
        return list(job.drive(env))


def evaluate_policy(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    seeds: range,
    *,
    in_order: bool = False,
    late_share: float = episodes.MAX_LATE_SHARE,
    workers: int | None = None,
    address: str | None = None,
    **options: Any,
) -> EvaluationRun:
    """Evaluate a policy in worlds of the test split, with a progress bar; closes the link.

    An emergency stop, an interrupt, and a link that can't be opened again end it after an episode;
    the finished episodes are kept. An episode depends on its seed alone, so the results in several
    processes are those of one.

    Args:
        policy: The policy.
        link: Name of the link; more than one worker need a simulated robot.
        robot: Preset, file or config of the robot; None for the default.
        seeds: Seeds of the episodes.
        in_order: Use the env's worlds one after the other, instead of random ones.
        late_share: Largest share of late ticks in a valid episode, 0 to 1.
        workers: As for `jobs.run_jobs`.
        address: As for `jobs.run_jobs`.
        **options: Other arguments of the env.
    """
    with require_extra("an evaluation", "scipy"):  # before the first episode, not after the last
        import scipy  # noqa: F401, PLC0415
    config = RobotConfig.of(robot)
    is_parallel = address is not None or workers not in (None, 1)
    if is_parallel:
        _check_parallel(link, options)
    else:
        compile_ahead(policy, link, config)
    sent = SentPolicy.of(policy)
    env = make_env(policy, link, robot, options)
    resets = episodes.plan_resets(env, seeds, in_order=in_order)
    _warn_differences(policy)

    if is_parallel:
        job = EpisodeJob(sent, link, config, options, resets=resets, late_share=late_share)
        running = _run_in_parallel(job, choose_part_size(job, workers), workers, address)
    else:
        running = episodes.run_resets(env, policy, resets, late_share)
    with contextlib.closing(running):
        title = f"episodes, {report.escape_text(link)}"
        watched = report.watch_progress(title, running, len(seeds))
        about = {"in_order": in_order, "late_share": late_share}
        done = _collect_run(watched, env, policy, link, seeds=seeds, about=about)
    done.results.sort(key=lambda episode: seeds.index(episode.seed or 0))
    done.header.update(workers=workers if address else workers or 1, address=address)
    return done


def _check_parallel(link: str, options: Mapping[str, Any]) -> None:
    """Raise ConfigError if an evaluation needs a single process."""
    if link not in BODIES:
        raise ConfigError(
            f"--link {show_value(link)}: one process drives one robot: --workers and --address "
            f"need --link {' or '.join(BODIES)}"
        )
    if options.get("record") is not None:
        raise ConfigError("--record: one process records: leave out --workers")


def choose_part_size(job: EpisodeJob, workers: int | None) -> int:
    """Return how many episodes a process drives at a time: workers then end about together."""
    is_batched = job.link == "planar" and job.policy.load().act_many is not None
    limit = MAX_BATCHED_EPISODES if is_batched else MAX_PART_EPISODES
    size = len(job.resets) // (PARTS_PER_WORKER * workers) if workers else limit
    return max(1, min(limit, size))


def _run_in_parallel(
    whole: EpisodeJob, size: int, workers: int | None, address: str | None
) -> Generator[Episode, None, None]:
    """Yield the episodes of a job, `size` at a time in a process."""
    firsts = range(0, len(whole.resets), size)
    parts = [replace(whole, resets=whole.resets[first : first + size]) for first in firsts]
    with contextlib.closing(run_jobs(run_job, parts, workers, address)) as finished:
        for _, results in finished:
            yield from results


def drive_to_goal(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    goal: tuple[float, float],
    *,
    ready: Callable[[], object] = lambda: None,
    late_share: float = episodes.MAX_LATE_SHARE,
    **options: Any,
) -> EvaluationRun:
    """Run one episode to `goal` (x, y) [m] in the odometry frame; arguments as `evaluate_policy`.

    `ready` is called before anything moves, after everything that is known about the policy has
    been printed. With `goal_distance`, goals may be nearer or farther than those of the training,
    and the time limit grows with the distance.
    """

    def drive(env: Env) -> Iterator[Episode]:
        ready()
        return episodes.run_episodes(env, policy, 1, seed=0, goal=goal, late_share=late_share)

    about = {"goal": goal, "late_share": late_share}
    return drive_to_goals(
        policy,
        link,
        robot,
        drive=drive,
        farthest=math.hypot(*goal),
        about=about,
        seeds=range(1),
        **options,
    )


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
        policy: The policy; refused on a real robot of another size or speed.
        link: Name of the link.
        robot: Preset, file or config of the robot; None for the default.
        drive: Makes the episodes.
        farthest: Distance of the farthest goal [m]; with `goal_distance`, the time limit grows
            with it.
        about: What the header contains about the episodes.
        seeds: Seeds of the episodes; None if they count up from 0.
        **options: Other arguments of the env.
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
        _warn_differences(policy)
        return _collect_run(drive(env), env, policy, link, seeds=seeds, about=about)


def _warn_differences(policy: FilePolicy) -> None:
    """Issue an AcsarWarning for each way in which task and robot differ from the training."""
    for line in policy.differences:
        warnings.warn(f"{policy.path}: {line}", AcsarWarning, stacklevel=3)


def refuse_outside(policy: FilePolicy) -> None:
    """Raise PolicyError if the robot has another size or speed than those of the training."""
    if policy.outside and not policy.anyway:
        raise PolicyError(
            f"{policy.path}: this robot's {', its '.join(policy.outside)} in the training: "
            f"{RETRAIN_HINT}, or drive all the same with --anyway"
        )


def _collect_run(
    running: Iterable[Episode],
    env: Env,
    policy: FilePolicy,
    link: str,
    *,
    seeds: range | None,
    about: Mapping[str, Any],
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
    header = provenance.make_header(env, policy, link, seeds, about)
    return EvaluationRun(header, describe_worlds(inner), driven, ended)


def describe_worlds(env: RobotEnv) -> str:
    """Describe the worlds of an env. A real robot is in none of them."""
    link = env.robot.link
    is_placed = not link.is_real or (link.ros is not None and link.ros.is_simulated)
    return str(env.pool) if env.pool is not None and is_placed else "none"

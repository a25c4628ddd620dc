"""Loads policies, makes their envs, and evaluates them: `evaluate` and `run`."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
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
    check_extra,
    escape_unprintable,
    format_error,
    show_value,
)
from acsar_gym.links import Link
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
from acsar_gym.worlds.sets import name_alone, name_sources

Env = gymnasium.Env[Any, Any]
MAX_EPISODES = 10**6
"""Most episodes of one evaluation: all results are kept in memory."""
SEED_LIMIT = 2**63
"""The first seed must be below this."""
MAX_PART_EPISODES = 10
MAX_BATCHED_EPISODES = 250
"""Most episodes of a job, one by one and in planar batches, so that an interrupt loses little."""
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
    """What ended it before its last episode. None for an evaluation that is complete."""

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
            **metrics.replace_nonfinite(vars(self.summary)),
            "ended_early": self.ended_early,
            "per_episode": metrics.replace_nonfinite(self.results),
        }


def load_policy(policy: Any, *, trust: bool, env: str = "") -> FilePolicy:
    """Load a policy: a file, a packaged one, a baseline, or Python code such as "mine.py:act".

    Args:
        policy: Its path or name. Files come first, then packaged policies, then baselines. Or a
            function or class of a module, as in "mine.module:Planner", or an object, see
            `CallablePolicy`.
        trust: Whether it may be a stable-baselines3 zip, which can run code when it is loaded.
        env: Id or short name of the env that it is for, by default that of the file.

    Raises:
        PolicyError: There is no such policy, or it is a zip without `trust`.
        ConfigError: There is no such `env`.
    """
    env_id = find_id(env) if env else ""

    # An object that the user has made, which no other process can load from a file.
    if isinstance(policy, FilePolicy):
        if env_id:
            policy.env_id = env_id
            policy.env_named = True
        return policy
    if is_callable(policy):
        return CallablePolicy(policy, env_id)
    if baselines.is_baseline(policy):
        return baselines.load_baseline(policy, env_id)

    # Files run no code, but for zips.
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
        policy: The policy. Only the user, not the file, may name an env of another package.
        link: Name of the link, or an open link.
        robot: Preset, file or config of the robot.
        options: Other arguments of the env. None means the env's default. Worlds such as
            "clutter", and those of an env that trains in a training split, become their test split.
            "clutter:train" means the training split.

    Raises:
        PolicyError: No env is named, it can't be made, its observation is another one, or a real
            robot isn't one of those that the policy is for.
        ConfigError: The env doesn't have one of the arguments.
    """
    # Options that the user didn't name are left to the env.
    env_id = _check_id(policy)
    kwargs: dict[str, Any] = {"link": link, "robot": robot}
    kwargs |= {name: value for name, value in options.items() if value is not None}
    if "worlds" in kwargs:
        kwargs["worlds"] = name_alone(kwargs["worlds"], registry.TEST)
    try:
        env = gymnasium.make(env_id, **kwargs)

        # Only now is it known in which worlds the env trains.
        pool = getattr(env.unwrapped, "pool", None)
        if "worlds" not in kwargs and pool is not None and pool.split == registry.TRAIN:
            env.close()
            tested = name_sources([f"{group.generator}:{registry.TEST}" for group in pool.sets])
            env = gymnasium.make(env_id, **kwargs, worlds=tested)
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise PolicyError(f"{policy.path}: made for {env_id}: {format_error(error)}") from error

    inner = env.unwrapped
    try:
        if isinstance(inner, RobotEnv):
            _fit_policy(policy, inner)
    except BaseException:
        env.close()
        raise
    return env


def _fit_policy(policy: FilePolicy, env: RobotEnv) -> None:
    """Check that a policy fits an env, and give it what it may know of the env."""
    policy.check(env.task, env.sensors, env_policy_rate(env), env.robot.config)
    if env.robot.link.is_real and policy.outside and not policy.anyway:
        raise PolicyError(
            f"{policy.path}: this robot's {', its '.join(policy.outside)} in the training: "
            f"{RETRAIN_HINT}, or drive all the same with --anyway"
        )
    policy.bind(PolicyContext.of(env))
    if policy.privileged:
        policy.watch(env)


def _check_id(policy: FilePolicy) -> str:
    """Return the id of the env that a policy is for. PolicyError if it may not name it."""
    # The id comes from a file, perhaps of a stranger: it may import nothing.
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
    """Return the seeds of `count` episodes from `first` on. ConfigError if out of range."""
    if not 1 <= count <= MAX_EPISODES:
        raise ConfigError(f"--episodes {show_value(count)}: must be 1 to {MAX_EPISODES:,}")
    if not 0 <= first < SEED_LIMIT:
        raise ConfigError(f"--seed {show_value(first)}: must be 0 to 2^63 - 1")
    return range(first, first + count)


PolicyLoader = Callable[[], FilePolicy]
"""Gives a policy to a process that drives: itself, or code that is loaded there by its name."""


def send_policy(policy: FilePolicy) -> PolicyLoader:
    """Return what loads a policy in another process: code by its name, others by their bytes."""
    if not isinstance(policy, CallablePolicy) or policy.instance is not None:
        return partial(load_policy, policy, trust=False)
    name = f"{policy.path}:{policy.function}" if policy.function else str(policy.path)
    return partial(_load_code, name, policy.env_id, policy.sha256)


@lru_cache(maxsize=4)
def _load_code(name: str, env_id: str, sha256: str | None) -> FilePolicy:
    """Load code once in a process, for many jobs. PolicyError if it has changed."""
    policy = load_policy(name, trust=False, env=env_id)
    if policy.sha256 != sha256:
        raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
    return policy


@dataclass(frozen=True)
class EpisodeJob:
    """Episodes of a policy, for one process."""

    load: PolicyLoader
    link: str
    robot: RobotConfig = field(repr=False)
    options: Mapping[str, Any] = field(repr=False)
    """Other arguments of the env."""
    resets: Resets
    late_share: float = episodes.MAX_LATE_SHARE

    def make_env(self) -> Env:
        """Make the env of the episodes, and check that the policy fits, see `make_env`."""
        return make_env(self.load(), self.link, self.robot, self.options)

    def drive(self, env: Env) -> list[Episode]:
        """Drive the episodes in their env, and close it."""
        with contextlib.closing(env):
            return list(episodes.run_resets(env, self.load(), self.resets, self.late_share))


def run_job(job: EpisodeJob) -> list[Episode]:
    """Run the episodes of a job."""
    return job.drive(job.make_env())


def evaluate_policy(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    seeds: range,
    *,
    late_share: float = episodes.MAX_LATE_SHARE,
    workers: int | None = None,
    **options: Any,
) -> EvaluationRun:
    """Evaluate a policy in worlds of the test split, with a progress bar. Closes the link.

    An emergency stop, an interrupt, and a link that can't be opened again end it after an episode.
    The finished episodes are kept. An episode depends on its seed alone, so the results in several
    processes are those of one.

    Args:
        policy: The policy.
        link: Name of the link. More than one worker need a simulated robot.
        robot: Preset, file or config of the robot. None for the default.
        seeds: Seeds of the episodes.
        late_share: Largest share of late ticks in a valid episode, 0 to 1.
        workers: As for `jobs.run_jobs`.
        **options: Other arguments of the env.
    """
    # Several processes need robots of their own.
    workers = 1 if workers is None else workers
    is_parallel = workers != 1
    if is_parallel and link not in BODIES:
        raise ConfigError(
            f"--link {show_value(link)}: one process drives one robot: --workers needs --link "
            f"{' or '.join(BODIES)}"
        )
    if is_parallel and options.get("record") is not None:
        raise ConfigError("--record and --view: one process records: leave out --workers")

    resets: Resets = [(seed, {}) for seed in seeds]

    # The env of this process has checked the policy before others start.
    def drive(env: Env) -> Iterator[Episode]:
        if is_parallel:
            load = send_policy(policy)
            config = RobotConfig.of(robot)
            job = EpisodeJob(load, link, config, options, resets=resets, late_share=late_share)
            running = _run_parts(job, workers)
        else:
            running = episodes.run_resets(env, policy, resets, late_share)
        title = f"episodes, {report.escape_text(link)}"
        with contextlib.closing(running):
            yield from report.watch_progress(title, running, len(seeds))

    about = {"late_share": late_share}
    done = drive_episodes(policy, link, robot, drive, about=about, seeds=seeds, **options)
    done.results.sort(key=lambda episode: episode.seed or 0)
    done.header["workers"] = workers
    return done


def _run_parts(job: EpisodeJob, workers: int) -> Generator[Episode, None, None]:
    """Run a job in several processes, and yield its episodes in order of completion."""
    # Parts are so small that no worker waits long for the last of them.
    count = len(job.resets)
    limit = MAX_BATCHED_EPISODES if job.link == "planar" else MAX_PART_EPISODES
    size = max(1, min(limit, count // (PARTS_PER_WORKER * max(1, workers))))
    parts = [replace(job, resets=job.resets[i : i + size]) for i in range(0, count, size)]
    with contextlib.closing(run_jobs(run_job, parts, workers)) as results:
        for _, driven in results:
            yield from driven


def drive_to_goal(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    goal: tuple[float, float],
    *,
    ready: Callable[[], object] = lambda: None,
    late_share: float = episodes.MAX_LATE_SHARE,
    **options: Any,
) -> EvaluationRun:
    """Run one episode to `goal` (x, y) [m] in the odometry frame, as `drive_episodes`.

    `ready` is called before anything moves, after everything that is known about the policy has
    been printed.
    """

    def drive(env: Env) -> Iterator[Episode]:
        ready()
        return episodes.run_episodes(env, policy, 1, seed=0, goal=goal, late_share=late_share)

    about = {"goal": goal, "late_share": late_share}
    farthest = math.hypot(*goal)
    return drive_episodes(policy, link, robot, drive, about=about, farthest=farthest, **options)


def drive_episodes(
    policy: FilePolicy,
    link: str,
    robot: RobotSource,
    drive: Callable[[Env], Iterable[Episode]],
    *,
    about: Mapping[str, Any],
    seeds: range | None = None,
    farthest: float = 0.0,
    **options: Any,
) -> EvaluationRun:
    """Run the episodes that `drive` yields with an env of a policy. Closes the link.

    With the option `goal_distance`, goals may be nearer or farther than those of the training, and
    the time limit grows with the distance. An error of the link before the first result is raised,
    unless it is an emergency stop.

    Args:
        policy: The policy. It is refused on a real robot of another size or speed.
        link: Name of the link.
        robot: Preset, file or config of the robot. None for the default.
        drive: Makes the episodes.
        about: What the header contains about the episodes.
        seeds: Seeds of the episodes. None if they count up from 0.
        farthest: Distance of the farthest goal [m].
        **options: Other arguments of the env.
    """
    check_extra("an evaluation", "scipy", "scipy")  # before the first episode, not after the last

    # Farther goals need more time, and the policy sees distances in the scale of its training.
    if options.get("goal_distance") is not None and policy.scale:
        options["distance_scale"] = policy.scale
        steps = gymnasium.spec(_check_id(policy)).max_episode_steps
        if steps is not None:
            options["max_episode_steps"] = math.ceil(steps * max(1.0, farthest / policy.scale))
    compile_ahead(policy, link, RobotConfig.of(robot))
    env = make_env(policy, link, robot, options)

    # Whatever ends the drive early, finished episodes are results.
    results: list[Episode] = []
    ended: LinkError | KeyboardInterrupt | None = None
    try:
        for line in policy.differences:
            warnings.warn(f"{policy.path}: {line}", AcsarWarning, stacklevel=2)
        for episode in drive(env):
            results.append(episode)  # noqa: PERF402 - an error must leave the others
    except (EmergencyStopError, KeyboardInterrupt) as error:
        ended = error
    except LinkError as error:
        if not results:
            raise
        ended = error
    finally:
        env.close()  # before the files are hashed

    # A real robot is in none of the worlds.
    inner: Any = env.unwrapped
    device = inner.robot.link
    is_placed = not device.is_real or (device.ros is not None and device.ros.is_simulated)
    worlds = str(inner.pool) if inner.pool is not None and is_placed else "none"
    seeds = seeds or range(max(len(results), 1))
    header = provenance.make_header(env, policy, link, seeds, about)
    return EvaluationRun(header, worlds, results, ended)


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

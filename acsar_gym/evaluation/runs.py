"""What `evaluate`, `run` and `export` do: a policy file driving behind any link."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import registered
from acsar_gym.errors import ConfigError, PolicyError, shown
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import metrics, provenance, report
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.evaluation.metrics import Summary
from acsar_gym.links import Link, open_link
from acsar_gym.links.recording import RecordingLink
from acsar_gym.policies import (
    CallablePolicy,
    FilePolicy,
    OnnxPolicy,
    ZipPolicy,
    is_callable,
    resolve,
    statistics_beside,
)
from acsar_gym.policies.base import one_line, quoted
from acsar_gym.worlds import splits

Env = gymnasium.Env[Any, Any]
MOST_EPISODES = 10**6
"""Of one evaluation: all of their results are kept."""
SEEDS = 2**63
"""The seed of a first episode is less."""


@dataclass(frozen=True, slots=True)
class Run:
    """Episodes of a policy, and what they were measured with."""

    header: dict[str, Any]
    """See `provenance`."""
    worlds: str
    """For a title, such as "clutter 0 to 199 (test split)" or "none"."""
    results: list[EpisodeResult]

    @property
    def summary(self) -> Summary:
        """Rates and means of the episodes."""
        return metrics.summarise(self.results)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: header, means, and every episode."""
        episodes = metrics.per_episode(self.results)
        return {"header": self.header, **self.summary.as_dict(), "per_episode": episodes}


def load(policy: str, *, trust: bool, env: str = "") -> FilePolicy:
    """A policy to drive with: a file, a name, or a function as in "mine.py:act".

    With `trust` it may be a stable-baselines3 zip. `env` is the environment that it's for, instead
    of the one that it names. Raises PolicyError where there is none, and for a zip without `trust`
    or with statistics of VecNormalize beside it, which only `export` can use, and ConfigError for
    an `env` that nothing registers.
    """
    env_id = registered(env) if env else ""
    if is_callable(policy):
        return CallablePolicy(policy, env_id)
    path = resolve(policy)
    if path.suffix == ".zip":
        loaded = ZipPolicy(path, trust=trust, env_id=env_id)
        _statistics(path, None)
        return loaded
    file = OnnxPolicy(path)
    file.env_id, file.env_named = env_id or file.env_id, bool(env_id)
    return file


def made(policy: FilePolicy, link: str | Link, robot: Any, options: Mapping[str, Any]) -> Env:
    """The environment that a policy was trained for; PolicyError where it is another one now.

    A file can only choose among those of acsar_gym; others are imported where the user names them.
    Options whose value is None are left to the environment. Worlds of a kind alone are its test
    split, and so are those of an environment that trains in a training split: that has to be asked
    for by name, as in "clutter:train".
    """
    env_id = _allowed(policy)
    given = {name: value for name, value in options.items() if value is not None}
    given = {"link": link, "robot": robot, **given}
    if "worlds" in given:
        given["worlds"] = splits.tested(given["worlds"])
    env = _made(policy, env_id, given)
    pool = getattr(env.unwrapped, "pool", None)
    if "worlds" not in given and pool is not None and pool.split == splits.TRAIN:
        env.close()
        env = _made(policy, env_id, given | {"worlds": f"{pool.kind}:{splits.TEST}"})
    inner = env.unwrapped
    if isinstance(inner, RobotEnv):
        config = inner.robot.config
        policy.check(inner.task, inner.sensors, config.control_rate / inner.ticks_per_step)
    return env


def _allowed(policy: FilePolicy) -> str:
    """The id that a policy is for; PolicyError where it names none that it may."""
    env_id = quoted(policy.env_id)
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
        return registered(env_id)
    except ConfigError as error:
        raise PolicyError(f"{policy.path}: {error}") from None


def _made(policy: FilePolicy, env_id: str, options: Mapping[str, Any]) -> Env:
    try:
        return gymnasium.make(env_id, **options)
    except (gymnasium.error.Error, ImportError) as error:
        raise PolicyError(f"{policy.path}: made for {env_id}: {error}") from None
    except TypeError as error:
        names = ", ".join(options)
        raise ConfigError(f"{env_id} doesn't take all of: {names} ({one_line(error)})") from None


def seeds(first: int, count: int) -> range:
    """Seeds of so many episodes; ConfigError where there are too many, or none."""
    if not 1 <= count <= MOST_EPISODES:
        raise ConfigError(f"--episodes {shown(count)}: must be 1 to {MOST_EPISODES:,}")
    if not 0 <= first < SEEDS:
        raise ConfigError(f"--seed {shown(first)}: must be 0 to 2^63 - 1")
    return range(first, first + count)


def drive(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    seeds: range,
    *,
    how: Mapping[str, Any] | None = None,
    **options: Any,
) -> Run:
    """Episodes of a policy in worlds of the test split, behind a link and a progress bar.

    The link is closed whatever happens. `how` goes to `evaluation.episodes`, other options to the
    environment.
    """
    env, how, count = made(policy, link, robot, options), how or {}, len(seeds)
    try:
        running = evaluation.episodes(env, policy, count, seeds.start, **how)
        return _run(env, policy, link, seeds, how, track(link, running, count))
    finally:
        env.close()


def _run(
    env: Env,
    policy: FilePolicy,
    link: str,
    seeds: range,
    options: Mapping[str, Any],
    results: list[EpisodeResult],
) -> Run:
    inner: Any = env.unwrapped
    worlds = provenance.worlds_of(inner)
    header = provenance.header(env, policy, link, seeds, options)
    return Run(header, "none" if worlds is None else str(worlds), results)


def to_goal(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    goal: tuple[float, float],
    record: Path | None,
    **options: Any,
) -> Run:
    """One episode to a given goal, recorded to a file on request."""
    config = RobotConfig.of(robot)
    wire: Link = open_link(link, config)
    if record is not None:
        wire = RecordingLink(wire, record)
    env = made(policy, wire, config, options | {"on_fault": "raise"})
    try:
        results = list(evaluation.episodes(env, policy, 1, seed=0, goal=goal))
        return _run(env, policy, link, range(1), {"goal": goal}, results)
    finally:
        env.close()


def export(
    model: Path,
    out: Path,
    env_id: str,
    robot: str | None,
    *,
    trust: bool,
    vecnormalize: str | None = None,
) -> None:
    """Convert a stable-baselines3 zip to an ONNX policy for an env and a robot.

    An empty `env_id` is the zip's own. `vecnormalize` is the file of a VecNormalize that it was
    trained with, or "none"; PolicyError where one lies beside the zip and isn't named.
    """
    policy = ZipPolicy(model, trust=trust, env_id=registered(env_id) if env_id else "")
    statistics = _statistics(model, vecnormalize)
    env = made(policy, "planar", robot, {})
    from acsar_gym.policies import sb3_export  # noqa: PLC0415 - optional

    inner: Any = env.unwrapped
    width = env.observation_space.shape[0] if env.observation_space.shape else 0
    try:
        before = sb3_export.normalizer(statistics, width) if statistics else None
        sb3_export.export(policy.network, out, policy.env_id, inner.task, inner.sensors, before)
    finally:
        env.close()


def _statistics(model: Path, named: str | None) -> Path | None:
    """The file of a VecNormalize to use; PolicyError where one isn't named, but seems to belong."""
    if named is not None:
        return None if named == "none" else Path(named)
    found = statistics_beside(model)
    if found is not None:
        raise PolicyError(
            f"{model}: {found} is beside it: if it was trained with that VecNormalize, use "
            f"'acsar-gym export {model} policy.onnx --trust --vecnormalize {found}', otherwise "
            "--vecnormalize none"
        )
    return None


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
    with Progress(*columns, console=report.SafeConsole()) as progress:
        task = progress.add_task(report.plain(name), total=count, rate="-")
        for result in running:
            results.append(result)
            rate = sum(r.success for r in results) / len(results)
            progress.update(task, advance=1, rate=f"{rate:.0%}")
    return results

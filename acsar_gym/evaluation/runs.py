"""The commands `evaluate`, `run` and `export`: run policy files on any link."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium

from acsar_gym import baselines
from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import registered, without_module
from acsar_gym.errors import ConfigError, LinkError, PolicyError, PolicyWarning, optional, shown
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import provenance
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.evaluation.results import Run, collect, track
from acsar_gym.evaluation.tracks import TrackedEnv
from acsar_gym.links import Link, open_link
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
from acsar_gym.policies.describing import described, rate_of
from acsar_gym.worlds import splits

Env = gymnasium.Env[Any, Any]
MOST_EPISODES = 10**6
"""Most episodes of one evaluation; all results are kept in memory."""
SEEDS = 2**63
"""The first seed must be below this."""


def load(policy: str, *, trust: bool, env: str = "") -> FilePolicy:
    """Load a policy file, packaged policy, baseline, or function such as "mine.py:act".

    Args:
        policy: its path or name; files come first, then packaged policies, then baselines.
        trust: whether it may be a stable-baselines3 zip, which can run code when it is loaded.
        env: id or short name of the env that it is for; by default the one that the file names.

    Raises:
        PolicyError: there is no such policy, or it is a zip without `trust`, or a zip beside a
            saved VecNormalize, which must be converted with `export` first.
        ConfigError: there is no such `env`.
    """
    env_id = registered(env) if env else ""
    if is_callable(policy):
        return CallablePolicy(policy, env_id)
    if baselines.is_baseline(policy):
        return baselines.load(policy, env_id)
    path = resolve(policy, baselines.BASELINES)
    if path.suffix == ".zip":
        loaded = ZipPolicy(path, trust=trust, env_id=env_id)
        _statistics(loaded, None)
        return loaded
    file = OnnxPolicy(path)
    file.env_id, file.env_named = env_id or file.env_id, bool(env_id)
    return file


def made(policy: FilePolicy, link: str | Link, robot: Any, options: Mapping[str, Any]) -> Env:
    """Make the env that a policy was trained for, and check that it gives the same observation.

    Args:
        policy: the policy. Only the user, not the file, may name an env of another package.
        link: name of the link, or an open link.
        robot: preset, file or config of the robot.
        options: other arguments of the env; None means the env's default, and a true `tracked`
            that episodes get a track (see `tracks.TrackedEnv`). Worlds such as
            "clutter", and those of an env that trains in a training split, become their test
            split; "clutter:train" means the training split.

    Raises:
        PolicyError: no env is named, it can't be made, or its observation is another one.
        ConfigError: the env doesn't have one of the arguments.
    """
    env_id = _allowed(policy)
    given = {name: value for name, value in options.items() if value is not None}
    tracked = given.pop("tracked", False)
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
        policy.check(inner.task, inner.sensors, rate_of(inner), config)
        policy.bind(inner)
    return TrackedEnv(env) if tracked else env


def warn(policy: FilePolicy) -> None:
    """Issue a PolicyWarning for each way in which the robot differs from those of the training."""
    for line in policy.differences:
        warnings.warn(f"{policy.path}: {line}", PolicyWarning, stacklevel=3)


def _allowed(policy: FilePolicy) -> str:
    """Return the id of the env that a policy is for; PolicyError if it may not name it."""
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
    """Make an env; errors name the policy."""
    try:
        return gymnasium.make(env_id, **options)
    except (gymnasium.error.Error, ImportError) as error:
        raise PolicyError(f"{policy.path}: made for {env_id}: {error}") from None
    except TypeError as error:
        names = ", ".join(options)
        raise ConfigError(f"{env_id} doesn't take all of: {names} ({one_line(error)})") from None


def seeds(first: int, count: int) -> range:
    """Return the seeds of `count` episodes from `first` on; ConfigError if out of range."""
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
    elsewhere: Iterator[EpisodeResult] | None = None,
    **options: Any,
) -> Run:
    """Evaluate a policy in worlds of the test split, with a progress bar; closes the link.

    An emergency stop, an interrupt, and a link that can't be opened again end it after an episode;
    the finished episodes are kept.

    Args:
        policy: the policy.
        link: name of the link.
        robot: preset or file of the robot; None for the default.
        seeds: seeds of the episodes.
        how: keyword arguments of `episodes.episodes`.
        elsewhere: results of these episodes, in any order, if other processes run them.
        **options: other arguments of the env.

    Raises:
        AcsarError: see `made` and `episodes.episodes`.
        MissingExtraError: scipy isn't installed.
    """
    with optional("an evaluation", "scipy"):  # before the first episode, not after the last
        import scipy  # noqa: F401, PLC0415
    env, how, count = made(policy, link, robot, options), how or {}, len(seeds)
    warn(policy)
    results: list[EpisodeResult] = []
    try:
        running = elsewhere or evaluation.episodes(env, policy, count, seeds.start, **how)
        ended = collect(track(link, running, count), results)
        env.close()  # before the files are hashed
        return _run(env, policy, link, seeds, how, results, ended)
    finally:
        env.close()


def _run(
    env: Env,
    policy: FilePolicy,
    link: str,
    seeds: range,
    options: Mapping[str, Any],
    results: list[EpisodeResult],
    ended: LinkError | KeyboardInterrupt | None = None,
) -> Run:
    """Combine results and header."""
    inner: Any = env.unwrapped
    worlds = provenance.worlds_of(inner)
    header = provenance.header(env, policy, link, seeds, options)
    return Run(header, "none" if worlds is None else str(worlds), results, ended)


def to_goal(
    policy: FilePolicy,
    link: str,
    robot: str | None,
    goal: tuple[float, float],
    ready: Callable[[], object] = lambda: None,
    **options: Any,
) -> Run:
    """Run one episode to `goal` (x, y) [m] in the odometry frame; arguments as for `drive`.

    `ready` is called before anything moves, when all that can be known of the policy is told.

    With `goal_distance`, goals may be nearer or farther than those that the policy was trained for;
    the time limit grows with the distance.
    """
    if options.get("goal_distance") is not None:
        options |= _farther(policy, goal)
    config = RobotConfig.of(robot)
    env = made(policy, open_link(link, config), config, options)
    warn(policy)
    results: list[EpisodeResult] = []
    try:
        ready()
        running = evaluation.episodes(env, policy, 1, seed=0, goal=goal)
        ended = collect(running, results)
        env.close()
        return _run(env, policy, link, range(1), {"goal": goal}, results, ended)
    finally:
        env.close()


def _farther(policy: FilePolicy, goal: tuple[float, float]) -> dict[str, Any]:
    """Return the env's options for a goal at any distance: the policy's scale, and enough steps."""
    if not policy.scale:
        return {}
    steps = gymnasium.spec(_allowed(policy)).max_episode_steps
    longer = max(1.0, math.hypot(*goal) / policy.scale)
    more = {} if steps is None else {"max_episode_steps": math.ceil(steps * longer)}
    return {"distance_scale": policy.scale, **more}


def export(
    model: Path,
    out: Path,
    env_id: str,
    robot: str | None,
    *,
    trust: bool,
    vecnormalize: str | None = None,
) -> None:
    """Convert a stable-baselines3 zip to an ONNX policy.

    Args:
        model: the zip.
        out: ONNX file to write.
        env_id: id or short name of the env; empty for the one stored in the zip.
        robot: preset or file of the robot; None for the default.
        trust: whether the zip may be loaded, which can run code in it.
        vecnormalize: file of the VecNormalize that it was trained with, or "none".

    Raises:
        PolicyError: the zip can't be used, or a VecNormalize lies beside it but none is given.
    """
    policy = ZipPolicy(model, trust=trust, env_id=registered(env_id) if env_id else "")
    statistics = _statistics(policy, vecnormalize)
    env = made(policy, "planar", robot, {})
    from acsar_gym.policies import sb3_export  # noqa: PLC0415 - optional

    inner: Any = env.unwrapped
    try:
        known = policy.bundle
        if known is None or known.env.id != without_module(policy.env_id):
            known = described(inner, policy.env_id)
        before = sb3_export.normalizer(statistics, known.observation.width) if statistics else None
        sb3_export.export(policy.network, out, known, before)
    finally:
        env.close()


def _statistics(policy: ZipPolicy, named: str | None) -> Path | None:
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

"""RL Zoo on a compiled batch: what the recipes name as their `vec_env_wrapper`."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from acsar_gym.dynamics import Randomization
from acsar_gym.policies import sb3

SINGLE = ("link", "lidar", "on_fault", "view", "record", "render_mode", "disable_env_checker")
"""Arguments that only a single env has."""


def batch(env: VecEnv, *, randomize: bool = True, threads: int | None = None) -> VecEnv:
    """Replace the single envs that RL Zoo has made by one batch of as many robots.

    A single env stays as it is, so that RL Zoo evaluates and renders with the real one.

    Args:
        env: of one id, all with the same arguments.
        randomize: draw the physics of each episode, as `acsar-gym train` does.
        threads: cores to use; None is all.

    Returns:
        The batch, with the Monitor file of the envs if they had one.
    """
    if env.num_envs == 1:
        return env
    spec = env.get_attr("spec", 0)[0]
    config = env.get_attr("unwrapped", 0)[0].robot.config
    options = {name: value for name, value in spec.kwargs.items() if name not in SINGLE}
    if randomize:
        options.setdefault("randomization", Randomization.measured(config))
    made: VecEnv = sb3.make_batch(spec.id, env.num_envs, threads=threads, **options)
    made._seeds = list(env._seeds)  # noqa: SLF001 - what make_vec_env has seeded
    log = _closed(env)
    if log is None:
        return made
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a batch has the statistics of Monitor already
        return VecMonitor(made, str(log))


def _closed(env: VecEnv) -> Path | None:
    """Close the envs and remove their empty monitor files; returns the path of the first one."""
    logs = [Path(path) for path in _logs(env)]
    env.close()
    for path in logs:
        path.unlink(missing_ok=True)
    return logs[0] if logs else None


def _logs(env: VecEnv) -> Iterator[str]:
    """Yield the paths of the monitor files of a DummyVecEnv."""
    if isinstance(env, DummyVecEnv):
        for each in env.envs:
            with contextlib.suppress(AttributeError):
                writer: Any = each.results_writer if isinstance(each, Monitor) else None
                yield writer.file_handler.name

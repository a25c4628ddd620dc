"""One trial of a sweep: train at one level of randomization, evaluate at another."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.levels import WIDTHS, level
from acsar_gym.envs import ids
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import metrics, runs
from acsar_gym.reading import structured
from acsar_gym.training import recipes, run
from acsar_gym.training.algorithms import algorithm
from acsar_gym.training.options import Options

HARDEST = max(WIDTHS)
"""The level at which policies are evaluated."""


def trial(env: str, number: int, seed: int, steps: int | None = None, count: int = 200) -> float:
    """Train PPO with the env's recipe at one level of randomization, and evaluate the policy.

    It takes one core, and leaves no files.

    Args:
        env: short name or id of the env.
        number: level of randomization of the training: 0 is none, 2 that of `acsar-gym train`, 1
            and 3 half and twice of it; see `acsar_gym.dynamics.levels`.
        seed: of the training.
        steps: env steps of the training; None for the recipe's.
        count: episodes of the evaluation, with the seeds from 0 on, on planar robots.

    Returns:
        Success rate at the hardest level, 0 to 1.

    Raises:
        AcsarError: see `training.run.train` and `evaluation.runs.made`.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        file = out / "recipe.yml"
        file.write_text(structured.to_yaml(randomized(env, number)), encoding="utf-8")
        asked: dict[str, Any] = {"steps": steps, "conf_file": file, "randomize": number > 0}
        run.train(Options(env=env, seed=seed, out=out, threads=1, progress=False, **asked))
        return success(out / "policy.onnx", count)


def randomized(env: str, number: int) -> dict[str, Any]:
    """Return the env's recipe for PPO with the randomization of a level, as a recipe file has it.

    Args:
        env: short name or id of the env.
        number: of the level, 0 to 3.

    Raises:
        ConfigError: there is no such env or level.
    """
    env_id = ids.without_module(ids.registered(env))
    found = recipes.recipe(algorithm("ppo"), env_id).as_dict()
    if number:
        ranges = asdict(level(RobotConfig.of(None), number))
        known = {name: list(each) for name, each in ranges.items() if each is not None}
        found["env_kwargs"] = {**found["env_kwargs"], "randomization": known}
    return {env_id: found}


def success(policy: Path, count: int) -> float:
    """Return the success rate of a policy file at the hardest level, 0 to 1.

    Args:
        policy: the ONNX file.
        count: episodes, with the seeds from 0 on.
    """
    loaded = runs.load(str(policy), trust=False)
    env = runs.made(loaded, "planar", None, {"randomization": level(RobotConfig.of(None), HARDEST)})
    try:
        return metrics.summarise(list(evaluation.episodes(env, loaded, count, 0))).success_rate
    finally:
        env.close()

"""The table of docs/scaling.md: the CPU time of trainings and evaluations.

    python tests/measure/costs.py

It measures CPU times in this process, which don't grow with other load of the machine.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.run import make_model

NAMES = ("point_goal", "obstacle_goal", "barn")
ROLLOUTS = 3
"""Rollouts and updates that are measured, after a rollout and an update that aren't."""


class TrainingCosts(NamedTuple):
    """CPU times of a training."""

    steps: int
    rollout: float
    """Of an env step, with the decision [s]."""
    update: float
    """Of the update, per env step [s]."""


def measure_episode(name: str, count: int) -> float:
    """Measure the CPU time of an episode of the packaged policy in PyBullet [s]."""
    policy = runs.load_policy(name, trust=False)
    env = runs.make_env(policy, "bullet", None, {})
    with contextlib.closing(env):
        list(run_episodes(env, policy, 2, seed=10_000))
        start = time.process_time()
        list(run_episodes(env, policy, count, seed=0))
        return (time.process_time() - start) / count


def measure_training(name: str) -> TrainingCosts:
    """Measure rollouts and updates of a training."""
    spent = {"collect_rollouts": 0.0, "train": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        options = TrainingOptions(env=name, threads=1, progress=False, out=Path(folder))
        plan = TrainingPlan.of(options)
        env = plan.make_training_batch()
        with contextlib.closing(env):
            model: Any = make_model(plan, env, Path(folder))
            for method in spent:
                setattr(model, method, add_time(getattr(model, method), method, spent))

            rollout = model.n_steps * env.num_envs
            model.learn(rollout)
            spent.update(dict.fromkeys(spent, 0.0))
            model.learn(ROLLOUTS * rollout, reset_num_timesteps=False)
    steps = ROLLOUTS * rollout
    return TrainingCosts(
        plan.recipe.steps, spent["collect_rollouts"] / steps, spent["train"] / steps
    )


def add_time(
    function: Callable[..., Any], name: str, spent: dict[str, float]
) -> Callable[..., Any]:
    """Return the function, which adds the CPU time of its calls to `spent`."""

    def call(*arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[name] += time.process_time() - start

    return call


def main() -> None:
    """Measure, and print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20, help="to measure, of each id")
    episodes = parser.parse_args().episodes
    print("| id | episode in PyBullet | steps | rollout | update | one training |")
    print("|---|---|---|---|---|---|")
    for name in NAMES:
        steps, rollout, update = measure_training(name)
        print(
            f"| {name} | {measure_episode(name, episodes) * 1e3:.0f} ms | {steps:,} "
            f"| {rollout * 1e6:.1f} us | {update * 1e6:.1f} us "
            f"| {steps * (rollout + update) / 60.0:.1f} min |"
        )


if __name__ == "__main__":
    main()

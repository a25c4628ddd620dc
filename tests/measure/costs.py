"""The table of docs/scaling.md: the CPU time of trainings and evaluations.

    python tests/measure/costs.py

It measures CPU times in this process, which don't grow with other load of the machine.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.run import make_model

NAMES = ("point_goal", "obstacle_goal", "barn")
ROLLOUTS = 3
"""Rollouts and updates that are measured, after a rollout and an update that aren't."""


def measure_episode(name: str, count: int) -> float:
    """Measure the CPU time of an episode of the packaged policy in PyBullet [s]."""
    policy = runs.load_policy(name, trust=False)
    env = runs.make_env(policy, "bullet", None, {})
    with contextlib.closing(env):
        list(run_episodes(env, policy, 2, seed=10_000))
        start = time.process_time()
        list(run_episodes(env, policy, count, seed=0))
        return (time.process_time() - start) / count


def measure_training(name: str) -> tuple[int, float, float]:
    """Return a training's steps, and the CPU times of a rollout and an update per env step [s]."""
    spent: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        plan = TrainingPlan.of(
            TrainingOptions(env=name, threads=1, progress=False, out=Path(folder))
        )
        with contextlib.closing(plan.make_training_batch()) as env:
            model: Any = make_model(plan, env, Path(folder))
            for method in ("collect_rollouts", "train"):
                setattr(model, method, partial(add_time, spent, method, getattr(model, method)))

            rollout = model.n_steps * env.num_envs
            model.learn(rollout)
            spent.clear()
            model.learn(ROLLOUTS * rollout, reset_num_timesteps=False)
    steps = ROLLOUTS * rollout
    return plan.recipe.steps, spent["collect_rollouts"] / steps, spent["train"] / steps


def add_time(spent: Any, name: str, function: Any, *arguments: Any, **options: Any) -> Any:
    """Call a function, and add its CPU time to `spent`."""
    start = time.process_time()
    result = function(*arguments, **options)
    spent[name] += time.process_time() - start
    return result


def main() -> None:
    """Measure, and print the table as Markdown."""
    print("| id | episode in PyBullet | steps | rollout | update | one training |")
    print("|---|---|---|---|---|---|")
    for name in NAMES:
        steps, rollout, update = measure_training(name)
        print(
            f"| {name} | {measure_episode(name, 20) * 1e3:.0f} ms | {steps:,} "
            f"| {rollout * 1e6:.1f} us | {update * 1e6:.1f} us "
            f"| {steps * (rollout + update) / 60.0:.1f} min |"
        )


if __name__ == "__main__":
    main()

"""The tables of docs/scaling.md: what trainings and evaluations cost on 1, 10 and 100 machines.

    python tests/scale/costs.py

It measures CPU times in this process, which don't grow with what else the machine does, and puts
them into the model of docs/scaling.md.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.runs import MAX_PART_EPISODES
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.run import make_model

NAMES = ("point_goal", "obstacle_goal", "barn")
MACHINES = (1, 10, 100)
CORES = 2
"""Of a machine."""
EPISODES = 1000
SEEDS = 5
SWEEP = 100
"""Trainings of a sweep."""
ROLLOUTS = 3
"""Rollouts and updates that are measured, after one that isn't."""


@dataclass(frozen=True)
class Costs:
    """CPU times of one id [s]."""

    name: str
    episode: float
    """Of an episode in PyBullet."""
    steps: int
    """Of a training."""
    rollout: float
    """Of an env step of a training, the decision included."""
    update: float
    """Of the update, per env step."""

    @property
    def training(self) -> float:
        """Of a training."""
        return self.steps * (self.rollout + self.update)


def episode(name: str, count: int) -> float:
    """Measure an episode of the packaged policy in PyBullet."""
    policy = runs.load_policy(name, trust=False)
    env = runs.make_env(policy, "bullet", None, {})
    with contextlib.closing(env):
        list(run_episodes(env, policy, 2, seed=10_000))
        begin = time.process_time()
        list(run_episodes(env, policy, count, seed=0))
        return (time.process_time() - begin) / count


def training(name: str) -> tuple[int, float, float]:
    """Measure rollouts and updates of a training; returns its steps and their costs [s]."""
    spent = {"collect_rollouts": 0.0, "train": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        options = TrainingOptions(env=name, threads=1, progress=False, out=Path(folder))
        plan = TrainingPlan.of(options)
        env = plan.make_training_batch()
        with contextlib.closing(env):
            model: Any = make_model(plan, env, Path(folder))
            for method in spent:
                setattr(model, method, timed(getattr(model, method), method, spent))
            rollout = model.n_steps * env.num_envs
            model.learn(rollout)
            spent.update(dict.fromkeys(spent, 0.0))
            model.learn(ROLLOUTS * rollout, reset_num_timesteps=False)
    steps = ROLLOUTS * rollout
    return plan.recipe.steps, spent["collect_rollouts"] / steps, spent["train"] / steps


def timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """Add up the CPU time of calls."""

    def call(*arguments: Any, **options: Any) -> Any:
        begin = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[name] += time.process_time() - begin

    return call


def start() -> float:
    """Measure the CPU time of a process that has just loaded what an evaluation needs [s]."""
    script = (
        "from acsar_gym.tools.evaluation import runs, episodes\n"
        "policy = runs.load_policy('point_goal', trust=False)\n"
        "env = runs.make_env(policy, 'bullet', None, {})\n"
        "list(episodes.run_episodes(env, policy, 1, seed=0))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", script], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def jobs(count: int, each: float, machines: int, begin: float) -> float:
    """How long independent jobs take on some machines, by the model [s]."""
    return begin + math.ceil(count / (machines * CORES)) * each


def alone(costs: Costs, machines: int, begin: float) -> float:
    """How long one training takes whose rollouts are spread over machines, by the model [s]."""
    return begin + costs.steps * (costs.rollout / (machines * CORES) + costs.update)


def words(seconds: float) -> str:
    """A time as people write it."""
    for size, unit in ((86_400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def show(found: list[Costs], begin: float) -> None:
    """Print both tables, as Markdown."""
    print(f"\nstart of a process: {begin:.1f} s\n")
    print("| id | episode in PyBullet | steps | rollout | update | share of updates | training |")
    print("|---|---|---|---|---|---|---|")
    for each in found:
        share = each.update / (each.rollout + each.update)
        print(
            f"| {each.name} | {each.episode * 1e3:.0f} ms | {each.steps:,} "
            f"| {each.rollout * 1e6:.1f} us | {each.update * 1e6:.1f} us | {share:.0%} "
            f"| {words(each.training)} |"
        )
    print(f"\n| what | {' | '.join(f'{n} machines' for n in MACHINES)} |")
    print(f"|---|{'---|' * len(MACHINES)}")
    for each in found:
        rows: dict[str, Callable[[int], float]] = {
            f"evaluation, {EPISODES:,} episodes": lambda n, e=each: jobs(  # type: ignore[misc]
                EPISODES // MAX_PART_EPISODES, MAX_PART_EPISODES * e.episode, n, begin
            ),
            f"training, {SEEDS} seeds": lambda n, e=each: jobs(SEEDS, e.training, n, begin),  # type: ignore[misc]
            f"sweep, {SWEEP} trainings": lambda n, e=each: jobs(SWEEP, e.training, n, begin),  # type: ignore[misc]
            "one training, rollouts spread": lambda n, e=each: alone(e, n, begin),  # type: ignore[misc]
        }
        for what, cost in rows.items():
            cells = (f"{words(cost(n))}, {words(n * cost(n))} of machines" for n in MACHINES)
            print(f"| {each.name}: {what} | {' | '.join(cells)} |")


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20, help="to measure, of each id")
    asked = parser.parse_args()
    start()
    found = []
    for name in NAMES:
        steps, rollout, update = training(name)
        found.append(Costs(name, episode(name, asked.episodes), steps, rollout, update))
    show(found, start())


if __name__ == "__main__":
    main()

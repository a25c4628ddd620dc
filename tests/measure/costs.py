"""Measure what trainings and evaluations cost on 1, 10 and 100 machines, for docs/scaling.md.

    python tests/measure/costs.py

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
from pathlib import Path
from typing import Any, NamedTuple

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
ROLLOUTS = 3
"""Rollouts and updates that are measured, after one that isn't."""
EVALUATION = """
from acsar_gym.tools.evaluation import runs, episodes
policy = runs.load_policy('point_goal', trust=False)
env = runs.make_env(policy, 'bullet', None, {})
list(episodes.run_episodes(env, policy, 1, seed=0))
"""


class Training(NamedTuple):
    """CPU times of a training [s]."""

    steps: int
    rollout: float
    """Of an env step, the decision included."""
    update: float
    """Of the update, per env step."""

    @property
    def time(self) -> float:
        """Of the training."""
        return self.steps * (self.rollout + self.update)


def measure_episode(name: str, count: int) -> float:
    """Measure an episode of the packaged policy in PyBullet [s]."""
    policy = runs.load_policy(name, trust=False)
    with contextlib.closing(runs.make_env(policy, "bullet", None, {})) as env:
        list(run_episodes(env, policy, 2, seed=10_000))
        begin = time.process_time()
        list(run_episodes(env, policy, count, seed=0))
        return (time.process_time() - begin) / count


def measure_training(name: str) -> Training:
    """Measure rollouts and updates of a training."""
    spent = {"collect_rollouts": 0.0, "train": 0.0}

    def add_time(model: Any, method: str) -> None:
        """Let a method of the model add up the time of its calls."""
        function = getattr(model, method)

        def call(*arguments: Any, **options: Any) -> Any:
            begin = time.process_time()
            result = function(*arguments, **options)
            spent[method] += time.process_time() - begin
            return result

        setattr(model, method, call)

    with tempfile.TemporaryDirectory() as folder:
        options = TrainingOptions(env=name, threads=1, progress=False, out=Path(folder))
        plan = TrainingPlan.of(options)
        with contextlib.closing(plan.make_training_batch()) as env:
            model: Any = make_model(plan, env, Path(folder))
            for method in spent:
                add_time(model, method)
            steps = model.n_steps * env.num_envs
            model.learn(steps)
            spent.update(dict.fromkeys(spent, 0.0))
            model.learn(ROLLOUTS * steps, reset_num_timesteps=False)
    measured = ROLLOUTS * steps
    return Training(
        plan.recipe.steps, spent["collect_rollouts"] / measured, spent["train"] / measured
    )


def measure_start() -> float:
    """Measure the CPU time of a process that loads what an evaluation needs [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", EVALUATION], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def show_duration(seconds: float) -> str:
    """Write a duration in the largest unit that gives at least two."""
    for size, unit in ((86_400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def show_scaling(name: str, episode: float, training: Training, begin: float) -> None:
    """Print how long jobs take on some machines, by the model."""

    def divide(jobs: int, duration: float) -> Callable[[int], float]:
        return lambda machines: begin + math.ceil(jobs / (machines * CORES)) * duration

    rows: dict[str, Callable[[int], float]] = {
        f"evaluation, {EPISODES:,} episodes": divide(
            EPISODES // MAX_PART_EPISODES, MAX_PART_EPISODES * episode
        ),
        "training, 5 seeds": divide(5, training.time),
        "sweep, 100 trainings": divide(100, training.time),
        "one training, rollouts spread": lambda machines: (
            begin + training.steps * (training.rollout / (machines * CORES) + training.update)
        ),
    }
    for job, duration in rows.items():
        times = [(machines, duration(machines)) for machines in MACHINES]
        cells = (f"{show_duration(t)}, {show_duration(n * t)} of machines" for n, t in times)
        print(f"| {name}: {job} | {' | '.join(cells)} |")


def main() -> None:
    """Measure, and print both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20, help="to measure, of each id")
    episodes = parser.parse_args().episodes
    measure_start()  # which compiles
    begin = measure_start()
    costs = [(name, measure_episode(name, episodes), measure_training(name)) for name in NAMES]

    print(f"\nstart of a process: {begin:.1f} s\n")
    print("| id | episode in PyBullet | steps | rollout | update | share of updates | training |")
    print("|---|---|---|---|---|---|---|")
    for name, episode, training in costs:
        share = training.update / (training.rollout + training.update)
        print(
            f"| {name} | {episode * 1e3:.0f} ms | {training.steps:,} "
            f"| {training.rollout * 1e6:.1f} us | {training.update * 1e6:.1f} us | {share:.0%} "
            f"| {show_duration(training.time)} |"
        )
    print(f"\n| what | {' | '.join(f'{n} machines' for n in MACHINES)} |")
    print(f"|---|{'---|' * len(MACHINES)}")
    for name, episode, training in costs:
        show_scaling(name, episode, training, begin)


if __name__ == "__main__":
    main()

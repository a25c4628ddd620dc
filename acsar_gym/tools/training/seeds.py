"""Several seeds of a training, in parallel or on a cluster.

Each seed gets a folder, such as runs/obstacle_goal/3/seed-0, with its output in seed-0-log.txt, and
a row in seeds.csv. If the machine of a seed dies, the seed goes on on another machine.
"""

from __future__ import annotations

import contextlib
import csv
import math
import re
import shutil
import statistics
from pathlib import Path
from typing import Any, NamedTuple

from acsar_gym import reading
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.jobs import run_jobs
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED, TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.run import require_training, train

MAX_SEEDS = 1000
"""Most seeds of one command."""
_SEEDS = re.compile(r"\d{1,10}(-\d{1,10})?(,\d{1,10}(-\d{1,10})?)*", re.ASCII)


class SeedResult(NamedTuple):
    """The result of a seed's training, a row of seeds.csv."""

    seed: int
    success_rate: float
    """Of the held-out episodes after the training."""
    collision_rate: float
    steps: int
    seconds: float


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: It has another form, or has too many seeds.
    """
    seeds: set[int] = set()
    for item in text.split(",") if _SEEDS.fullmatch(text) else ():
        first, _, last = item.partition("-")
        numbers = range(int(first), int(last or first) + 1)
        seeds |= set(numbers[: MAX_SEEDS + 1] or [FIRST_HELD_OUT_SEED])
    if not 1 <= len(seeds) <= MAX_SEEDS or max(seeds) >= FIRST_HELD_OUT_SEED:
        raise ConfigError(
            f"--seeds {show_value(text)}: must be like 0-4 or 1,5,9: at most {MAX_SEEDS:,} of "
            "0 to 2^32 - 1"
        )
    return sorted(seeds)


def train_seeds(options: TrainingOptions) -> list[SeedResult]:
    """Train every seed of `options.seeds`, and print their held-out success rates.

    Raises:
        ConfigError: An option can't be used.
        AcsarError: See `jobs.run_jobs` and `run.train`.
    """
    require_training()
    seeds = parse_seeds(options.seeds or "")
    TrainingPlan.of(options.model_copy(update={"threads": 1}))  # raises the errors of all seeds
    out = folders.make_folder(options.out, options.env.rpartition("/")[2]).resolve()

    # One thread for each seed, so that they don't wait for each other.
    changes: dict[str, Any] = dict.fromkeys(("seeds", "workers", "address"))
    changes |= {"progress": False, "threads": options.threads or 1}
    jobs = [
        options.model_copy(update={**changes, "seed": seed, "out": out / f"seed-{seed}"})
        for seed in seeds
    ]

    results: list[SeedResult] = []
    running = run_jobs(train_seed, jobs, options.workers, options.address)
    try:
        with contextlib.closing(running):
            for _, result in report.watch_progress("seeds trained", running, len(jobs)):
                results.append(result)
                print(
                    f"seed {result.seed}: held-out success {result.success_rate:.1%}, collisions "
                    f"{result.collision_rate:.1%} after {result.steps:,} steps in "
                    f"{result.seconds:,.0f} s",
                    flush=True,
                )
    finally:
        if results:
            _summarize(results, out)
    return sorted(results)


def train_seed(options: TrainingOptions) -> SeedResult:
    """Train one seed, or go on with it in its folder, and print into its log."""
    out = options.out or Path()
    if folders.find_models(out):  # a process of this job has died
        options = options.model_copy(update={"resume": out, "trust": True})
    else:
        shutil.rmtree(out, ignore_errors=True)

    with (
        out.with_name(f"{out.name}-log.txt").open("a", encoding="utf-8") as log,
        contextlib.redirect_stdout(log),
    ):
        result = train(options)
    score = result.score
    return SeedResult(
        options.seed,
        success_rate=score.success_rate if score else math.nan,
        collision_rate=score.collision_rate if score else math.nan,
        steps=result.steps,
        seconds=round(result.seconds, 1),
    )


def _summarize(results: list[SeedResult], out: Path) -> None:
    """Print median and worst seed, and write seeds.csv."""
    rates = [result.success_rate for result in results]
    median = statistics.median(rates)
    behind = 100.0 * (median - min(rates))
    print(f"median {median:.1%}, worst {min(rates):.1%}: {behind:.1f} points below the median")
    with reading.replace_file(out / "seeds.csv") as new, new.open("w", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([SeedResult._fields, *sorted(results)])

"""Several seeds of a training, in parallel or on a cluster.

Each seed gets a folder, such as runs/obstacle_goal/3/seed-0, with what it printed in log.txt.
seeds.csv contains the table. A seed whose machine of a cluster died goes on on another machine.
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

from rich.table import Table

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
LOG_FILE = "log.txt"
SEEDS_FILE = "seeds.csv"
_SEED_RANGE = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?", re.ASCII)


class SeedResult(NamedTuple):
    """What the training of a seed came to; a row of seeds.csv."""

    seed: int
    success_rate: float
    """Of the held-out episodes after the training."""
    collision_rate: float
    steps: int
    seconds: float


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: It isn't one, or has too many.
    """
    seeds: set[int] = set()
    for range_text in text.split(","):
        match = _SEED_RANGE.fullmatch(range_text)
        if match is not None:
            first = int(match[1])
            last = min(int(match[2] or first), first + MAX_SEEDS)
            seeds |= set(range(first, last + 1))
        if match is None or last < first or last >= FIRST_HELD_OUT_SEED or len(seeds) > MAX_SEEDS:
            raise ConfigError(
                f"--seeds {show_value(text)}: must be like 0-4 or 1,5,9: at most {MAX_SEEDS:,} of "
                "0 to 2^32 - 1"
            )
    return sorted(seeds)


def train_seeds(options: TrainingOptions) -> list[SeedResult]:
    """Train every seed of `options.seeds`, and print a table of their held-out success rates.

    Raises:
        ConfigError: An option can't be used.
        AcsarError: See `jobs.run_jobs` and `run.train`.
    """
    require_training()
    seeds = parse_seeds(options.seeds or "")
    plan = TrainingPlan.of(options.model_copy(update={"threads": 1}))
    out = folders.make_folder(options.out, plan.short_name)
    changes: dict[str, Any] = {"seeds": None, "workers": None, "address": None, "progress": False}
    changes["threads"] = options.threads or 1
    jobs = [
        options.model_copy(update=changes | {"seed": seed, "out": out.resolve() / f"seed-{seed}"})
        for seed in seeds
    ]

    results: list[SeedResult] = []
    running = run_jobs(train_seed, jobs, workers=options.workers, address=options.address)
    try:
        with contextlib.closing(running):
            for _, result in report.watch_progress("seeds trained", running, len(jobs)):
                results.append(result)
                print(
                    f"seed {result.seed}: held-out success {result.success_rate:.1%} after "
                    f"{result.steps:,} steps in {result.seconds:,.0f} s",
                    flush=True,
                )
    finally:
        results.sort()
        if results:
            _print_results(f"{options.algo} on {options.env}", results, out)
    return results


def train_seed(options: TrainingOptions) -> SeedResult:
    """Train one seed, or go on with it in its folder; what it prints goes into the folder."""
    out = options.out or Path()
    if folders.find_models(out):  # a process of this job has died
        options = options.model_copy(update={"resume": out, "trust": True})
    else:
        shutil.rmtree(out, ignore_errors=True)

    out.parent.mkdir(parents=True, exist_ok=True)
    log_file = out.with_name(f"{out.name}-{LOG_FILE}")
    with log_file.open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
        result = train(options)
    score = result.score
    return SeedResult(
        options.seed,
        success_rate=math.nan if score is None else score.success_rate,
        collision_rate=math.nan if score is None else score.collision_rate,
        steps=result.steps,
        seconds=round(result.seconds, 1),
    )


def _print_results(title: str, results: list[SeedResult], out: Path) -> None:
    """Print the table, and write it as CSV."""
    table = Table(title=report.escape_text(f"{title}, {len(results)} seeds"))
    for name in ("seed", "held-out success", "collision", "steps", "time"):
        table.add_column(name, justify="right")
    for result in results:
        rates = (f"{result.success_rate:.1%}", f"{result.collision_rate:.1%}")
        table.add_row(str(result.seed), *rates, f"{result.steps:,}", f"{result.seconds:,.0f} s")
    report.print_tables(table)

    success = [result.success_rate for result in results]
    median = statistics.median(success)
    behind = 100.0 * (median - min(success))
    print(f"median {median:.1%}, worst {min(success):.1%}: {behind:.1f} points below the median")
    with reading.replace_file(out / SEEDS_FILE) as new, new.open("w", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(SeedResult._fields)
        writer.writerows(results)

"""Several seeds of a training, in parallel or on a cluster.

Each seed gets a folder, such as runs/obstacle_goal/3/seed-0, with its output in seed-0-log.txt, and
a row in seeds.csv. If the machine of a seed dies, the seed goes on on another machine.
"""

from __future__ import annotations

import contextlib
import shutil
import statistics
from collections.abc import Mapping
from pathlib import Path

from acsar_gym.config.fleet import make_fleet
from acsar_gym.errors import ConfigError, explain_error, show_value
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.jobs import run_jobs
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED, TrainingOptions
from acsar_gym.tools.training.plan import Score, TrainingPlan
from acsar_gym.tools.training.run import require_training, train

MAX_SEEDS = 1000
"""Most seeds of one command."""
TABLE_FILE = "seeds.csv"


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: It has another form, or has too many seeds.
    """
    # Ranges are cut, as 0-9999999999 would fill the memory.
    try:
        ends = [item.partition("-") for item in text.split(",")]
        ranges = [range(int(first), int(last if dash else first) + 1) for first, dash, last in ends]
        seeds = sorted({seed for numbers in ranges for seed in numbers[: MAX_SEEDS + 1]})
    except ValueError:
        seeds = []
    if not 1 <= len(seeds) <= MAX_SEEDS or seeds[-1] >= FIRST_HELD_OUT_SEED:
        raise ConfigError(
            f"--seeds {show_value(text)}: must be like 0-4 or 1,5,9: at most {MAX_SEEDS:,} of "
            "0 to 2^32 - 1"
        )
    return seeds


def train_seeds(options: TrainingOptions) -> dict[int, Score]:
    """Train every seed of `options.seeds`, and print their held-out scores.

    Returns:
        The score of each seed after its training.

    Raises:
        ConfigError: An option can't be used.
        AcsarError: See `jobs.run_jobs` and `run.train`.
    """
    require_training()
    seeds = parse_seeds(options.seeds or "")
    # One thread for each seed, so that they don't wait for each other.
    shared = {"seeds": None, "workers": None, "address": None, "progress": False}
    single = options.model_copy(update={**shared, "threads": options.threads or 1})
    # These raise the errors of all seeds.
    TrainingPlan.of(single)
    make_fleet(single.robot)

    out = folders.make_folder(options.out, options.env.rpartition("/")[2]).resolve()
    # Only one of two commands that started at the same time can create the file.
    try:
        (out / TABLE_FILE).touch(exist_ok=False)
    except OSError as error:
        reason = explain_error(error)
        raise ConfigError(f"--out {out}: {TABLE_FILE} can't be created: {reason}") from error
    jobs = [single.model_copy(update={"seed": seed, "out": out / f"seed-{seed}"}) for seed in seeds]

    # Scores are printed in the order in which the trainings end.
    scores: dict[int, Score] = {}
    try:
        running = run_jobs(train_seed, jobs, options.workers, options.address)
        with contextlib.closing(running):
            for number, score in report.watch_progress("seeds trained", running, len(jobs)):
                scores[seeds[number]] = score
                print(
                    f"seed {seeds[number]}: held-out success {score.success_rate:.1%}, collisions "
                    f"{score.collision_rate:.1%} after {score.steps:,} steps in "
                    f"{score.seconds:,.0f} s",
                    flush=True,
                )
    finally:
        # Whatever ended the others, finished seeds are results.
        if scores:
            _summarize(scores, out)
        # If no seed was started, as without a cluster, the same command can be repeated.
        elif not any(out.glob("seed-*")):
            (out / TABLE_FILE).unlink()
    return scores


def train_seed(options: TrainingOptions) -> Score:
    """Train one seed, or go on with it in its folder, and print into its log."""
    out = options.out or Path()
    if folders.find_models(out):  # a process of this job has died
        options = TrainingOptions(resume=out, trust=True)
    else:
        shutil.rmtree(out, ignore_errors=True)

    log = out.with_name(f"{out.name}-log.txt").open("a", encoding="utf-8")
    with log, contextlib.redirect_stdout(log):
        return train(options).score


def _summarize(scores: Mapping[int, Score], out: Path) -> None:
    """Print median and worst seed, and write seeds.csv."""
    rates = [score.success_rate for score in scores.values()]
    median = statistics.median(rates)
    behind = 100.0 * (median - min(rates))
    print(f"median {median:.1%}, worst {min(rates):.1%}: {behind:.1f} points below the median")
    rows = [(seed, *score) for seed, score in sorted(scores.items())]
    folders.write_table(out / TABLE_FILE, ("seed", *Score._fields), rows)

"""Trains several seeds of a recipe, in parallel or on a cluster, and compares them.

    acsar-gym train --env obstacle_goal --seeds 0-4 --workers 2 --out runs/obstacle_goal

Every seed gets a folder as of a training alone, such as runs/obstacle_goal/seed-3, with what the
training printed in log.txt; seeds.json has the table. A seed whose process died goes on at its
newest checkpoint on this machine, and begins again on another machine of a cluster.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import signal
import statistics
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro
from rich.table import Table

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, escape_unprintable, show_value
from acsar_gym.physics.randomization import LEVEL_WIDTHS, randomization_level
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import metrics, report, runs
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.training import checkpoints, held_out, recipes, record, run
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.tools.training.recipes import find_algorithm
from acsar_gym.tools.training.record import CHECKPOINTS_FOLDER
from acsar_gym.tools.training.run import train

MAX_SEEDS = 1000
"""Most seeds of one command."""
_PART = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?", re.ASCII)
_SEEDS = f"must be like 0-4 or 1,5,9: at most {MAX_SEEDS:,} of 0 to 2^32 - 1"
LOG_FILE = "log.txt"
TABLE_FILE = "seeds.json"
MAX_SENT_BYTES = 100_000_000
"""Largest file that is sent to another machine [bytes]."""
UNSENT_FOLDERS = (CHECKPOINTS_FOLDER, "tensorboard")
"""Folders of a training that another machine keeps."""


@dataclass(frozen=True)
class SeedJob:
    """The training of one seed."""

    options: TrainingOptions
    begun: float
    """When the command began: older checkpoints aren't gone on with [s since 1970]."""
    sent: tuple[tuple[str, str, bytes], ...] | None = field(default=None, repr=False)
    """Options that name files, with their names and contents, for another machine, which sends
    the training's files back; None for this machine."""


@dataclass(frozen=True)
class SeedResult:
    """What the training of a seed came to."""

    seed: int
    success_rate: float
    """Of the held-out episodes after the training; NaN where it was ended early."""
    collision_rate: float
    steps: int
    seconds: float
    files: bytes = b""
    """Zip of its files, from another machine."""


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: it isn't one, or has too many.
    """
    found: set[int] = set()
    for part in text.split(","):
        matched = _PART.fullmatch(part)
        first, last = (int(matched[1]), int(matched[2] or matched[1])) if matched else (1, 0)
        if not first <= last < min(held_out.FIRST_HELD_OUT_SEED, first + MAX_SEEDS):
            raise ConfigError(f"--seeds {show_value(text)}: {_SEEDS}")
        found |= set(range(first, last + 1))
    if len(found) > MAX_SEEDS:
        raise ConfigError(f"--seeds {show_value(text)}: {_SEEDS}")
    return sorted(found)


def train_seeds(options: TrainingOptions) -> int:
    """Train every seed of `options.seeds`, and print a table of their held-out success rates.

    Args:
        options: the user's options.

    Returns:
        Exit code: 0.

    Raises:
        ConfigError: an option can't be used for several seeds.
        AcsarError: see `scaling.completed` and `training.run.train`.
    """
    options.check()
    seeds = parse_seeds(options.seeds or "")
    if options.resume is not None:
        raise ConfigError("--resume: goes on with one training: leave out --seeds")
    out = TrainingPlan.of(replace(options, threads=1)).out
    jobs = [make_job(options, seed, out) for seed in seeds]
    results: dict[int, SeedResult] = {}
    running = completed(run_job, jobs, workers=options.workers, address=options.address)
    try:
        with contextlib.closing(running):
            for _, trained in report.watch_progress("seeds trained", running, len(jobs)):
                results[trained.seed] = trained
                keep_files(trained, out)
                print(escape_unprintable(_line(trained)), flush=True)
    finally:
        _tell(options, results, out)
    return 0


def make_job(options: TrainingOptions, seed: int, out: Path) -> SeedJob:
    """Make the job of a seed.

    Args:
        options: the user's options.
        seed: the seed.
        out: folder of all seeds.

    Raises:
        ConfigError: an option names what can't be sent to another machine.
    """
    alone = replace(
        options,
        seed=seed,
        seeds=None,
        out=out / f"seed-{seed}",
        threads=options.threads or 1,
        progress=False,
        workers=None,
        address=None,
    )
    return SeedJob(alone, time.time(), None if options.address is None else _files(options))


def _files(options: TrainingOptions) -> tuple[tuple[str, str, bytes], ...]:
    """Read the files that options name, which another machine may not have.

    Raises:
        ConfigError: an option names a folder, or a file can't be read.
    """
    found = []
    for name in ("conf_file", "robot", "worlds"):
        path = Path(getattr(options, name) or "")
        if getattr(options, name) is not None and path.is_file():
            found.append((name, path.name, reading.read_file(path, MAX_SENT_BYTES)))
        elif name == "worlds" and "/" in str(path) and path.is_dir():
            raise ConfigError(f"--worlds {path}: a folder can't be sent to a cluster: give a file")
    return tuple(found)


def run_job(job: SeedJob) -> SeedResult:
    """Train one seed; what it prints goes into its folder."""
    if job.sent is None:
        return _run(job)
    with tempfile.TemporaryDirectory(prefix="acsar_gym-") as folder:
        changes: dict[str, Any] = {"out": Path(folder, "out")}
        for option, name, content in job.sent:
            place = Path(folder, option, name)
            place.parent.mkdir()
            place.write_bytes(content)
            changes[option] = place if option == "conf_file" else str(place)
        away = replace(job, options=replace(job.options, **changes))
        return replace(_run(away), files=_zipped(changes["out"]))


def _run(job: SeedJob) -> SeedResult:
    """Train one seed in its folder, or go on with it there."""
    from acsar_gym.tools.training import run as training  # noqa: PLC0415

    options, out = job.options, job.options.out or Path()
    out.mkdir(parents=True, exist_ok=True)
    newer = [
        path
        for path in checkpoints.find_checkpoints(out / CHECKPOINTS_FOLDER)
        if _after(path, job.begun)
    ]
    with (out / LOG_FILE).open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
        again = replace(options, resume=out, trust=True) if newer else options
        _raise_signal(training.train(again))
    return _result(out, options.seed)


def _raise_signal(code: int) -> None:
    """End what runs the jobs, too, if a signal ended a training."""
    if code == 128 + signal.SIGINT:
        raise KeyboardInterrupt
    if code:
        sys.exit(code)


def _after(path: Path, begun: float) -> bool:
    """Whether a file was written after a time [s since 1970]."""
    return path.stat().st_mtime >= begun


def _result(out: Path, seed: int) -> SeedResult:
    """Read the result of a training from its folder."""
    told = record.read_record(out)
    last = told.get("held_out") or {}
    success, collision = (
        float(last.get(name, math.nan)) for name in ("success_rate", "collision_rate")
    )
    return SeedResult(seed, success, collision, int(told["steps"]), float(told["seconds"]))


def _zipped(folder: Path) -> bytes:
    """Pack the files of a training."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder)
            if path.is_file() and name.parts[0] not in UNSENT_FOLDERS:
                archive.write(path, name)
    return content.getvalue()


def keep_files(trained: SeedResult, out: Path) -> None:
    """Write the files that another machine sent."""
    if not trained.files:
        return
    folder = out / f"seed-{trained.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(trained.files)) as archive:
        archive.extractall(folder)  # zipfile itself keeps names within the folder


def _line(trained: SeedResult) -> str:
    """Describe a finished training in one line."""
    return (
        f"seed {trained.seed}: held-out success {trained.success_rate:.1%} after "
        f"{trained.steps:,} steps in {trained.seconds:,.0f} s"
    )


def _tell(options: TrainingOptions, results: dict[int, SeedResult], out: Path) -> None:
    """Print the table, and write it as JSON."""
    if not results:
        return
    ordered = [results[seed] for seed in sorted(results)]
    table = Table(
        title=report.escape_text(f"{options.algo} on {options.env}, {len(ordered)} seeds")
    )
    for name in ("seed", "held-out success", "collision", "steps", "time"):
        table.add_column(name, justify="right")
    for each in ordered:
        rates = (f"{each.success_rate:.1%}", f"{each.collision_rate:.1%}")
        table.add_row(str(each.seed), *rates, f"{each.steps:,}", f"{each.seconds:,.0f} s")
    report.print_tables(table)
    summary = _summary([each.success_rate for each in ordered])
    if summary:
        print(
            f"median {summary['median']:.1%}, worst {summary['worst']:.1%}: "
            f"{100 * (summary['median'] - summary['worst']):.1f} points below the median"
        )
    data: dict[str, Any] = {"env": options.env, "algo": options.algo, **summary}
    data["seeds"] = [
        {name: value for name, value in asdict(each).items() if name != "files"} for each in ordered
    ]
    report.write_json(out / TABLE_FILE, metrics.replace_nonfinite(data))


def _summary(rates: list[float]) -> dict[str, float]:
    """Return the median and the worst of the known rates; empty where there are none."""
    known = [rate for rate in rates if math.isfinite(rate)]
    return {"median": statistics.median(known), "worst": min(known)} if known else {}


# One trial of a sweep: train at one level of randomization, evaluate at another.

HARDEST_LEVEL = max(LEVEL_WIDTHS)
"""The level at which policies are evaluated."""


def run_trial(
    env: str, number: int, seed: int, steps: int | None = None, count: int = 200
) -> float:
    """Train PPO with the env's recipe at one level of randomization, and evaluate the policy.

    It takes one core, and leaves no files.

    Args:
        env: short name or id of the env.
        number: level of randomization of the training: 0 is none, 2 that of `acsar-gym train`, 1
            and 3 half and twice of it; see `acsar_gym.physics.randomization`.
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
        file.write_text(reading.format_yaml(randomized_recipe(env, number)), encoding="utf-8")
        asked: dict[str, Any] = {"steps": steps, "conf_file": file, "randomize": number > 0}
        run.train(TrainingOptions(env=env, seed=seed, out=out, threads=1, progress=False, **asked))
        return measure_success(out / "policy.onnx", count)


def randomized_recipe(env: str, number: int) -> dict[str, Any]:
    """Return the env's recipe for PPO with the randomization of a level, as a recipe file has it.

    Args:
        env: short name or id of the env.
        number: of the level, 0 to 3.

    Raises:
        ConfigError: there is no such env or level.
    """
    env_id = ids.strip_module(ids.find_id(env))
    found = recipes.read_recipe(find_algorithm("ppo"), env_id).as_dict()
    if number:
        ranges = randomization_level(RobotConfig.of(None), number).model_dump()
        known = {name: list(each) for name, each in ranges.items() if each is not None}
        found["env_kwargs"] = {**found["env_kwargs"], "randomization": known}
    return {env_id: found}


def measure_success(policy: Path, count: int) -> float:
    """Return the success rate of a policy file at the hardest level, 0 to 1.

    Args:
        policy: the ONNX file.
        count: episodes, with the seeds from 0 on.
    """
    loaded = runs.load_policy(str(policy), trust=False)
    env = runs.make_env(
        loaded,
        "planar",
        None,
        {"randomization": randomization_level(RobotConfig.of(None), HARDEST_LEVEL)},
    )
    try:
        return metrics.summarise_episodes(
            list(evaluation.run_episodes(env, loaded, count, 0))
        ).success_rate
    finally:
        env.close()


# Train a policy on thousands of planar robots and export it as one ONNX file.
#
#     acsar-gym train --env obstacle_goal --out runs/obstacle_goal
#     acsar-gym train --env mine.module:mine/Clearance-v0 --steps 2000000 --algo sac
#     acsar-gym train --env obstacle_goal --seeds 0-4 --workers 2
#
# The hyperparameters are in agents/recipes/, in RL Zoo's format. Into the folder go:
#
# | file | for |
# |---|---|
# | policy.onnx | to drive with |
# | model.zip | to train on: --resume model.zip --trust begins a new training with it |
# | checkpoints/ | to go on after a kill: --resume FOLDER --trust, with the same learning curve |
# | config.yml | hyperparameters, versions, git revision, command line; also a --conf-file |
# | learning_curve.csv, .png | success, return and collisions of the held-out episodes |
# | tensorboard/ | these, and the algorithm's own figures |
#
# Ctrl-C and SIGTERM end it early, and save the model. The success rate on held-out robots, in
# worlds
# that aren't trained in, is logged as eval/success_rate; with --worlds FILE or FOLDER there are no
# other worlds, so it is measured in the same ones, with other seeds.


def main(arguments: Sequence[str]) -> int:
    """Train with the options of a command line; returns the exit code."""
    options = tyro.cli(TrainingOptions, prog="acsar-gym train", args=list(arguments))
    return train(options) if options.seeds is None else train_seeds(options)

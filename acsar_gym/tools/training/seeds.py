"""The command `acsar-gym train`, and several seeds of a recipe, in parallel or on a cluster.

Every seed gets a folder as of a training alone, such as runs/obstacle_goal/seed-3, with what the
training printed in log.txt; seeds.json has the table. A seed whose machine of a cluster died begins
again on another one.
"""

from __future__ import annotations

import contextlib
import math
import re
import signal
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import tyro
from rich.table import Table

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.fleet import make_fleet
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.physics.randomization import LEVEL_WIDTHS, randomization_level
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import metrics, report, runs
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.training import checkpoints, held_out, recipes, record
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan, require_training
from acsar_gym.tools.training.record import (
    CONFIG_FILE,
    CURVE_FILES,
    LOCK_FILE,
    SEED_PREFIX,
    SEEDS_FILE,
    claim_folder,
)
from acsar_gym.tools.training.run import train
from acsar_gym.worlds.files import format_world
from acsar_gym.worlds.search import lidar_height
from acsar_gym.worlds.sets import parse_sets, place_worlds

MAX_SEEDS = 1000
"""Most seeds of one command."""
_SEED_RANGE = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?", re.ASCII)
_SEEDS = f"must be like 0-4 or 1,5,9: at most {MAX_SEEDS:,} of 0 to 2^32 - 1"
LOG_FILE = "log.txt"
MAX_SENT_BYTES = 100_000_000
"""Largest file that is sent to another machine [bytes]."""
UNSENT = (CHECKPOINTS_FOLDER, "tensorboard", LOCK_FILE)
"""What another machine keeps of the folder of a training."""


@dataclass(frozen=True)
class SeedJob:
    """The training of one seed."""

    options: TrainingOptions
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
    files: dict[str, bytes] = field(default_factory=dict, repr=False)
    """Its files by name, from another machine."""


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: it isn't one, or has too many.
    """
    found: set[int] = set()
    for part in text.split(","):
        matched = _SEED_RANGE.fullmatch(part)
        first, last = (int(matched[1]), int(matched[2] or matched[1])) if matched else (1, 0)
        if not first <= last < min(held_out.FIRST_HELD_OUT_SEED, first + MAX_SEEDS):
            raise ConfigError(f"--seeds {show_value(text)}: {_SEEDS}")
        found |= set(range(first, last + 1))
    if len(found) > MAX_SEEDS:
        raise ConfigError(f"--seeds {show_value(text)}: {_SEEDS}")
    return sorted(found)


def train_seeds(options: TrainingOptions) -> int:
    """Train every seed of `options.seeds`, and print a table of their held-out success rates.

    Returns:
        Exit code: 0.

    Raises:
        ConfigError: an option can't be used for several seeds.
        AcsarError: see `jobs.completed` and `run.train`.
    """
    require_training()
    seeds = parse_seeds(options.seeds or "")
    if options.resume is not None:
        raise ConfigError("--resume: goes on with one training: leave out --seeds")
    plan = TrainingPlan.of(options.model_copy(update={"threads": 1}))
    results: dict[int, SeedResult] = {}
    with claim_folder(plan.out, numbered=options.out is None) as out:
        jobs = [make_job(options, seed, out) for seed in seeds]
        running = completed(run_job, jobs, workers=options.workers, address=options.address)
        try:
            with contextlib.closing(running):
                for _, trained in report.watch_progress("seeds trained", running, len(jobs)):
                    results[trained.seed] = trained
                    keep_files(trained, out)
                    said = (
                        f"seed {trained.seed}: held-out success {trained.success_rate:.1%} after "
                        f"{trained.steps:,} steps in {trained.seconds:,.0f} s"
                    )
                    print(said, flush=True)
        finally:
            if results:
                _print_results(options, [results[seed] for seed in sorted(results)], out)
    return 0


def make_job(options: TrainingOptions, seed: int, out: Path) -> SeedJob:
    """Make the job of a seed.

    Raises:
        ConfigError: an option names what can't be sent to another machine.
    """
    changes = {
        "seed": seed,
        "seeds": None,
        "out": out / f"{SEED_PREFIX}{seed}",
        "threads": options.threads or 1,
        "progress": False,
        "workers": None,
        "address": None,
    }
    alone = options.model_copy(update=changes)
    if options.address is None:
        return SeedJob(alone)
    sent = []
    for name in ("conf_file", "robot"):
        path = Path(getattr(options, name) or "")
        if path.is_file():
            sent.append((name, path.name, reading.read_file(path, MAX_SENT_BYTES)))

    # The files that a world's file names aren't on the other machine: send the world itself.
    names = list(options.worlds)
    source = place_worlds(names, options.start, options.goal)
    height = lidar_height(make_fleet(options.robot, 1).robots[0])
    for place, group in enumerate([] if source is None else parse_sets(source, height=height)):
        if len(group.worlds) > 1:
            raise ConfigError(
                f"--worlds {names[place]}: a folder can't be sent to a cluster: give a file"
            )
        for world in group.worlds:
            names[place] = f"{Path(names[place]).stem}.json"
            sent.append(("worlds", names[place], format_world(world, ".json")))
    placed = {"worlds": tuple(names), "start": None, "goal": None}
    return SeedJob(alone.model_copy(update=placed), tuple(sent))


def run_job(job: SeedJob) -> SeedResult:
    """Train one seed, or go on with it in its folder; what it prints goes into the folder, too."""
    with contextlib.ExitStack() as away:
        options, out = job.options, job.options.out or Path()
        if job.sent is not None:
            folder = away.enter_context(tempfile.TemporaryDirectory(prefix="acsar_gym-"))
            out = Path(folder, "out")
            changes: dict[str, Any] = {"out": out}
            for option, name, content in job.sent:
                place = Path(folder, option, name)
                place.parent.mkdir(exist_ok=True)
                place.write_bytes(content)
                changes[option] = place if option == "conf_file" else str(place)
            files = {path.name: str(path) for path in Path(folder, "worlds").glob("*")}
            changes["worlds"] = tuple(files.get(name, name) for name in options.worlds)
            options = options.model_copy(update=changes)
        out.mkdir(parents=True, exist_ok=True)
        if checkpoints.find_checkpoints(out / CHECKPOINTS_FOLDER):
            options = options.model_copy(update={"resume": out, "trust": True})
        else:  # a process of this job may have died before its first checkpoint
            for name in (CONFIG_FILE, *CURVE_FILES):
                (out / name).unlink(missing_ok=True)
        with (out / LOG_FILE).open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
            code = train(options)
        if code == 128 + signal.SIGINT:  # ends what runs the jobs, too
            raise KeyboardInterrupt
        if code:
            sys.exit(code)
        said = record.read_record(out)
        last = said.get("held_out") or {}
        made = {}
        for path in sorted(out.rglob("*")) if job.sent is not None else ():
            place = path.relative_to(out)
            if path.is_file() and place.parts[0] not in UNSENT:
                made[str(place)] = path.read_bytes()
        return SeedResult(
            options.seed,
            float(last.get("success_rate", math.nan)),
            float(last.get("collision_rate", math.nan)),
            int(said["steps"]),
            float(said["seconds"]),
            made,
        )


def keep_files(trained: SeedResult, out: Path) -> None:
    """Write the files that another machine sent."""
    for name, content in trained.files.items():
        path = out / f"{SEED_PREFIX}{trained.seed}" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def _print_results(options: TrainingOptions, results: Sequence[SeedResult], out: Path) -> None:
    """Print the table, and write it as JSON."""
    title = report.escape_text(f"{options.algo} on {options.env}, {len(results)} seeds")
    table = Table(title=title)
    for name in ("seed", "held-out success", "collision", "steps", "time"):
        table.add_column(name, justify="right")
    for each in results:
        shares = (f"{each.success_rate:.1%}", f"{each.collision_rate:.1%}")
        table.add_row(str(each.seed), *shares, f"{each.steps:,}", f"{each.seconds:,.0f} s")
    report.print_tables(table)
    data: dict[str, Any] = {"env": options.env, "algo": options.algo}
    rates = [each.success_rate for each in results if math.isfinite(each.success_rate)]
    if rates:
        median, worst = statistics.median(rates), min(rates)
        data |= {"median": median, "worst": worst}
        print(
            f"median {median:.1%}, worst {worst:.1%}: {100 * (median - worst):.1f} points below "
            "the median"
        )
    rows = [asdict(each) for each in results]
    data["seeds"] = [{n: value for n, value in row.items() if n != "files"} for row in rows]
    report.write_json(out / SEEDS_FILE, metrics.replace_nonfinite(data))


def run_trial(env: str, level: int, seed: int, steps: int | None = None, count: int = 200) -> float:
    """Train PPO with the env's recipe at one level of randomization, and evaluate the policy.

    It takes one core, and leaves no files.

    Args:
        env: short name or id of the env.
        level: of randomization in the training: 0 is none, 2 that of `acsar-gym train`, 1 and 3
            half and twice of it; see `physics.randomization`.
        seed: of the training.
        steps: env steps of the training; None for the recipe's.
        count: episodes of the evaluation, with the seeds from 0 on, on planar robots.

    Returns:
        Success rate at the hardest level, 0 to 1.

    Raises:
        AcsarError: see `run.train` and `evaluation.runs.make_env`.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, file = Path(folder), Path(folder, "recipe.yml")
        file.write_text(reading.format_yaml(randomized_recipe(env, level)), encoding="utf-8")
        asked: dict[str, Any] = {"steps": steps, "conf_file": file, "randomize": level > 0}
        asked |= {"seed": seed, "out": out, "threads": 1, "progress": False}
        train(TrainingOptions(env=env, **asked))
        policy = runs.load_policy(str(out / "policy.onnx"), trust=False)
    hardest = randomization_level(RobotConfig.of(None), max(LEVEL_WIDTHS))
    harder = runs.make_env(policy, "planar", None, {"randomization": hardest})
    with contextlib.closing(harder):
        results = list(evaluation.run_episodes(harder, policy, count, 0))
    return metrics.summarise_episodes(results).success_rate


def randomized_recipe(env: str, level: int) -> dict[str, Any]:
    """Return the env's recipe for PPO with the randomization of a level, as a recipe file has it.

    Raises:
        ConfigError: there is no such env or level.
    """
    env_id = ids.strip_module(ids.find_id(env))
    found = recipes.read_recipe(recipes.find_algorithm("ppo"), env_id).as_dict()
    if level:
        ranges = randomization_level(RobotConfig.of(None), level).model_dump()
        known = {name: list(each) for name, each in ranges.items() if each is not None}
        found["env_kwargs"] = {**found["env_kwargs"], "randomization": known}
    return {env_id: found}


def main(arguments: Sequence[str]) -> int:
    """Train with the options of a command line: one training, or with --seeds several.

    Ctrl-C and SIGTERM end it early, and save the model.

    Returns:
        The exit code.
    """
    options = tyro.cli(TrainingOptions, prog="acsar-gym train", args=list(arguments))
    return train(options) if options.seeds is None else train_seeds(options)

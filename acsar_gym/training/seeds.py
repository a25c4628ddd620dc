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
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from acsar_gym.errors import ConfigError, printable, shown
from acsar_gym.evaluation import metrics, report
from acsar_gym.reading import bounded
from acsar_gym.scaling import completed
from acsar_gym.training import checkpoints, held_out, record
from acsar_gym.training.options import Options
from acsar_gym.training.plan import Plan
from acsar_gym.training.resuming import CHECKPOINTS

MOST = 1000
"""Most seeds of one command."""
_PART = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?", re.ASCII)
_SEEDS = f"must be like 0-4 or 1,5,9: at most {MOST:,} of 0 to 2^32 - 1"
LOG = "log.txt"
TABLE = "seeds.json"
MOST_BYTES = 100_000_000
"""Largest file that is sent to another machine [bytes]."""
LEFT_OUT = (CHECKPOINTS, "tensorboard")
"""Folders of a training that another machine keeps."""


@dataclass(frozen=True)
class Job:
    """The training of one seed."""

    options: Options
    begun: float
    """When the command began: older checkpoints aren't gone on with [s since 1970]."""
    sent: tuple[tuple[str, str, bytes], ...] | None = field(default=None, repr=False)
    """Options that name files, with their names and contents, for another machine, which sends
    the training's files back; None for this machine."""


@dataclass(frozen=True)
class Trained:
    """What the training of a seed came to."""

    seed: int
    success_rate: float
    """Of the held-out episodes after the training; NaN where it was ended early."""
    collision_rate: float
    steps: int
    seconds: float
    files: bytes = b""
    """Zip of its files, from another machine."""


def parsed(text: str) -> list[int]:
    """Return the seeds of a text such as "0-4" or "1,5,7-9".

    Raises:
        ConfigError: it isn't one, or has too many.
    """
    found: set[int] = set()
    for part in text.split(","):
        matched = _PART.fullmatch(part)
        first, last = (int(matched[1]), int(matched[2] or matched[1])) if matched else (1, 0)
        if not first <= last < min(held_out.FIRST_SEED, first + MOST):
            raise ConfigError(f"--seeds {shown(text)}: {_SEEDS}")
        found |= set(range(first, last + 1))
    if len(found) > MOST:
        raise ConfigError(f"--seeds {shown(text)}: {_SEEDS}")
    return sorted(found)


def train(options: Options) -> int:
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
    seeds = parsed(options.seeds or "")
    if options.resume is not None:
        raise ConfigError("--resume: goes on with one training: leave out --seeds")
    out = Plan.of(replace(options, threads=1)).out
    jobs = [job(options, seed, out) for seed in seeds]
    results: dict[int, Trained] = {}
    running = completed(run, jobs, workers=options.workers, address=options.address)
    try:
        with contextlib.closing(running):
            for _, trained in report.watched("seeds trained", running, len(jobs)):
                results[trained.seed] = trained
                keep(trained, out)
                print(printable(_line(trained)), flush=True)
    finally:
        _tell(options, results, out)
    return 0


def job(options: Options, seed: int, out: Path) -> Job:
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
    return Job(alone, time.time(), None if options.address is None else _files(options))


def _files(options: Options) -> tuple[tuple[str, str, bytes], ...]:
    """Read the files that options name, which another machine may not have.

    Raises:
        ConfigError: an option names a folder, or a file can't be read.
    """
    found = []
    for name in ("conf_file", "robot", "worlds"):
        path = Path(getattr(options, name) or "")
        if getattr(options, name) is not None and path.is_file():
            found.append((name, path.name, bounded.read(path, MOST_BYTES)))
        elif name == "worlds" and "/" in str(path) and path.is_dir():
            raise ConfigError(f"--worlds {path}: a folder can't be sent to a cluster: give a file")
    return tuple(found)


def run(job: Job) -> Trained:
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


def _run(job: Job) -> Trained:
    """Train one seed in its folder, or go on with it there."""
    from acsar_gym.training import run as training  # noqa: PLC0415

    options, out = job.options, job.options.out or Path()
    out.mkdir(parents=True, exist_ok=True)
    newer = [path for path in checkpoints.found(out / CHECKPOINTS) if _after(path, job.begun)]
    with (out / LOG).open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
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


def _result(out: Path, seed: int) -> Trained:
    """Read the result of a training from its folder."""
    told = record.read(out)
    last = told.get("held_out") or {}
    success, collision = (
        float(last.get(name, math.nan)) for name in ("success_rate", "collision_rate")
    )
    return Trained(seed, success, collision, int(told["steps"]), float(told["seconds"]))


def _zipped(folder: Path) -> bytes:
    """Pack the files of a training."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder)
            if path.is_file() and name.parts[0] not in LEFT_OUT:
                archive.write(path, name)
    return content.getvalue()


def keep(trained: Trained, out: Path) -> None:
    """Write the files that another machine sent."""
    if not trained.files:
        return
    folder = out / f"seed-{trained.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(trained.files)) as archive:
        archive.extractall(folder)  # zipfile itself keeps names within the folder


def _line(trained: Trained) -> str:
    """Describe a finished training in one line."""
    return (
        f"seed {trained.seed}: held-out success {trained.success_rate:.1%} after "
        f"{trained.steps:,} steps in {trained.seconds:,.0f} s"
    )


def _tell(options: Options, results: dict[int, Trained], out: Path) -> None:
    """Print the table, and write it as JSON."""
    if not results:
        return
    ordered = [results[seed] for seed in sorted(results)]
    table = Table(title=report.plain(f"{options.algo} on {options.env}, {len(ordered)} seeds"))
    for name in ("seed", "held-out success", "collision", "steps", "time"):
        table.add_column(name, justify="right")
    for each in ordered:
        rates = (f"{each.success_rate:.1%}", f"{each.collision_rate:.1%}")
        table.add_row(str(each.seed), *rates, f"{each.steps:,}", f"{each.seconds:,.0f} s")
    report.show(table)
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
    report.write_json(out / TABLE, metrics.finite(data))


def _summary(rates: list[float]) -> dict[str, float]:
    """Return the median and the worst of the known rates; empty where there are none."""
    known = [rate for rate in rates if math.isfinite(rate)]
    return {"median": statistics.median(known), "worst": min(known)} if known else {}

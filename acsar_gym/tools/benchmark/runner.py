"""Runs a plan in a folder of its own, where each result is kept at once.

| file | content |
|---|---|
| `plan.json` | what is measured, with hashes; see `Plan.as_dict` |
| `cells.jsonl` | a line for each finished cell, from which `--resume` continues |
| `benchmark.json` | the result; see `table.make_result` |
"""

from __future__ import annotations

import contextlib
import json
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import CancelledError, ConfigError, PolicyError, explain_error
from acsar_gym.tools.benchmark.figures import score_episode
from acsar_gym.tools.benchmark.plan import ROS2, Cell, Plan
from acsar_gym.tools.benchmark.table import CellResult, describe_cell
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.runs import EpisodeJob
from acsar_gym.tools.jobs import run_jobs

RUNS = Path("runs/benchmark")
"""Folder of the folders of benchmarks."""
PLAN_FILE = "plan.json"
CELLS_FILE = "cells.jsonl"
RESULT_FILE = "benchmark.json"
MAX_FILE_BYTES = 2_000_000_000
"""Largest accepted file of a folder [bytes]; 1,000 episodes have 0.6 MB."""
WHOLE_FIELDS = ("seed", "world", "timing")
"""Fields of an episode for which None isn't NaN."""


def open_folder(plan: Plan, out: Path | None, resume: Path | None) -> Path:
    """Return the folder of a benchmark, with its plan.

    Args:
        plan: The plan.
        out: New or empty folder; by default the next number in RUNS.
        resume: Folder of a benchmark that is to be continued.

    Raises:
        ConfigError: `out` isn't empty, or `resume` was made by another plan.
    """
    about = json.loads(json.dumps(plan.as_dict()))
    if resume is not None:
        text = reading.read_file(resume / PLAN_FILE, MAX_FILE_BYTES)
        if difference := find_difference(reading.parse_json(text), about):
            raise ConfigError(
                f"--resume {resume}: {difference} has changed since the benchmark was started: "
                "start a new one, without --resume"
            )
        return resume

    folder = out or _next_folder(RUNS)
    report.make_folder(folder)
    if any(folder.iterdir()):
        raise ConfigError(f"--out {folder}: isn't empty: name a new folder, or --resume {folder}")
    report.write_json(folder / PLAN_FILE, about)
    return folder


def _next_folder(parent: Path) -> Path:
    """Make the folder with the next free number."""
    report.make_folder(parent)
    for number in count(1):
        with contextlib.suppress(FileExistsError):
            (parent / str(number)).mkdir()
            return parent / str(number)
    raise AssertionError  # there is always another number


def find_difference(one: Any, other: Any, name: str = "") -> str:
    """Return the dotted name of the first difference between two plans; empty for none."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            if key not in one or key not in other:
                return f"{name}{key}"
            if difference := find_difference(one[key], other[key], f"{name}{key}."):
                return difference
        return ""
    return "" if one == other else name.rstrip(".")


def run_plan(
    plan: Plan, folder: Path, *, workers: int | None = None, address: str | None = None
) -> dict[Cell, CellResult]:
    """Drive the cells that aren't finished, and keep each at once; returns all in order.

    Raises:
        CancelledError: After Ctrl-C; its message names the command that continues.
    """
    plan.check()
    cells = list(plan.cells())
    results = read_results(folder, cells)
    waiting = [cell for cell in cells if cell not in results]
    if ROS2 in plan.links:
        workers = 1  # there is one robot

    running = run_jobs(drive_cell, [cell.job for cell in waiting], workers, address)
    try:
        with contextlib.closing(running):
            for number, result in report.watch_progress("cells", running, len(waiting)):
                cell = waiting[number]
                results[cell] = score_cell(cell, result)
                write_results(folder, {cell: results[cell]}, mode="a")
    except KeyboardInterrupt as error:
        raise CancelledError(
            f"interrupted: {len(results)} of {len(cells)} cells are finished; the same command "
            f"with --resume {shlex.quote(str(folder))} drives the others"
        ) from error
    return {cell: results[cell] for cell in cells}


def drive_cell(job: EpisodeJob) -> CellResult:
    """Drive the scenes of a cell, or find out why the agent can't drive there at all.

    Raises:
        AcsarError: It can't be driven this time: a file or a package is missing.
    """
    start = time.process_time()
    try:
        env = job.make_env()
    except PolicyError as error:
        path = job.policy.load().path
        return CellResult(refused=str(error).replace(str(path), path.name))
    with contextlib.closing(env):
        episodes = list(job.drive(env))
    return CellResult(episodes, round(time.process_time() - start, 3))


def score_cell(cell: Cell, result: CellResult) -> CellResult:
    """Score the episodes of a cell."""
    scoring = cell.scoring
    scored = [
        replace(episode, score=score_episode(episode, scoring)) for episode in result.episodes
    ]
    return replace(result, episodes=scored)


def read_results(folder: Path, cells: Sequence[Cell]) -> dict[Cell, CellResult]:
    """Read the finished cells of a folder, and remove a last line that was cut."""
    file = folder / CELLS_FILE
    if not file.exists():
        return {}
    results = {}
    for line in reading.read_file(file, MAX_FILE_BYTES).splitlines(keepends=True):
        if line.endswith(b"\n"):
            data = reading.parse_json(line)
            (cell,) = [cell for cell in cells if cell.about.items() <= data.items()]
            episodes = [_read_episode(values) for values in data["episodes"]]
            results[cell] = CellResult(episodes, data["seconds"], data["refused"])
    write_results(folder, results, mode="w")
    return results


def _read_episode(values: Mapping[str, Any]) -> Episode:
    """Read an episode, in which None is NaN."""

    def read(name: str, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: read(key, number) for key, number in value.items()}
        if isinstance(value, list):
            return tuple(read(name, number) for number in value)
        return math.nan if value is None and name not in WHOLE_FIELDS else value

    return Episode(**{name: read(name, value) for name, value in values.items()})


def write_results(folder: Path, results: Mapping[Cell, CellResult], mode: str) -> None:
    """Write finished cells, a line each; ConfigError if that fails, as on a full disk."""
    file = folder / CELLS_FILE
    try:
        with file.open(mode, encoding="utf-8") as stream:
            for cell, result in results.items():
                line = json.dumps(describe_cell(cell, result), allow_nan=False)
                stream.write(f"{line}\n")
    except OSError as error:
        raise ConfigError(f"{file}: {explain_error(error)}") from error

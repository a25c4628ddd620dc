"""Runs a plan in its own folder, where each result is kept at once.

| file | content |
|---|---|
| `plan.json` | what is measured, with hashes, see `Plan.as_dict` |
| `cells.jsonl` | a line for each finished cell, from which `--resume` continues |
| `benchmark.json` | the result, see `report.make_result` |
"""

from __future__ import annotations

import contextlib
import json
import shlex
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import CancelledError, ConfigError, PolicyError, explain_error
from acsar_gym.tools.benchmark.plan import ROS2, Cell, Plan
from acsar_gym.tools.benchmark.report import CellResult
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.runs import EpisodeJob
from acsar_gym.tools.jobs import run_jobs
from acsar_gym.tools.training.folders import make_folder

PLAN_FILE = "plan.json"
CELLS_FILE = "cells.jsonl"
RESULT_FILE = "benchmark.json"
MAX_FILE_BYTES = 2_000_000_000
"""Largest accepted file of a folder [bytes]. 1,000 episodes have 0.6 MB."""


def open_folder(plan: Plan, out: Path | None, resume: Path | None) -> Path:
    """Return the folder of a benchmark, with its plan.

    Args:
        plan: The plan.
        out: New or empty folder, by default the next of runs/benchmark.
        resume: Folder of a benchmark that is to be continued.

    Raises:
        ConfigError: `out` isn't empty, `resume` was made by another plan, or a set doesn't have
            these scenes.
    """
    if resume is None and out is not None and out.is_dir() and any(out.iterdir()):
        raise ConfigError(
            f"--out {out}: isn't empty: name a new folder, or --resume {shlex.quote(str(out))}"
        )
    # Before the folder is made: a folder with the plan of wrong scenes couldn't be used.
    for scenes in plan.sets:
        scenes.check(plan.count_scenes(scenes))

    # As a file has it, with lists in the place of tuples.
    about = json.loads(json.dumps(plan.as_dict()))
    if resume is None:
        # No other run writes to it, so it needs no lock.
        folder = make_folder(out, "benchmark")
        report.write_json(folder / PLAN_FILE, about)
        return folder

    # Results of a benchmark are comparable only if nothing has changed while it ran.
    with reading.name_errors(f"--resume {resume}: {PLAN_FILE}"):
        old = reading.parse_json(reading.read_content(resume / PLAN_FILE, MAX_FILE_BYTES))
    for name in find_changes(old, about):
        raise ConfigError(
            f"--resume {resume}: {name or PLAN_FILE} has changed since the benchmark was started: "
            "start a new one, without --resume"
        )
    return resume


def find_changes(old: Any, new: Any, name: str = "") -> Iterator[str]:
    """Yield the dotted names of values that differ in nested dicts."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old | new:
            yield from find_changes(old.get(key), new.get(key), f"{name}.{key}".lstrip("."))
    elif old != new:
        yield name


def run_plan(
    plan: Plan, folder: Path, *, workers: int | None = None, address: str | None = None
) -> dict[Cell, CellResult]:
    """Drive the cells that aren't finished, and keep each at once. Returns all in order.

    Raises:
        CancelledError: After Ctrl-C. Its message names the command that continues.
    """
    # Cells that were finished before an interruption aren't driven again.
    cells = list(plan.cells())
    results = read_results(folder, cells)
    waiting = [cell for cell in cells if cell not in results]
    if ROS2 in plan.links:
        workers = 1  # there is one robot

    # Each result is kept at once: a kill or a full disk costs one cell.
    running = run_jobs(drive_cell, [cell.job for cell in waiting], workers, address)
    try:
        with contextlib.closing(running):
            for number, result in report.watch_progress("cells", running, len(waiting)):
                cell = waiting[number]
                # A job doesn't know the score of its set, so it is added here.
                results[cell] = replace(result, episodes=cell.score(result.episodes))
                append_result(folder, cell, results[cell])
    except KeyboardInterrupt as error:
        raise CancelledError(
            f"interrupted: {len(results)} of {len(cells)} cells are finished. The same command "
            f"with --resume {shlex.quote(str(folder))} drives the others"
        ) from error
    return {cell: results[cell] for cell in cells}


def drive_cell(job: EpisodeJob) -> CellResult:
    """Drive the scenes of a cell, or find out why the agent can't drive there at all.

    Raises:
        AcsarError: It can't be driven this time: a file or a package is missing.
    """
    # A refusal is a result. Other errors end the benchmark.
    start = time.process_time()
    try:
        env = job.make_env()
    except PolicyError as error:
        # The message has the file's full path, which differs between computers.
        path = job.load().path
        return CellResult(refused=str(error).replace(str(path), path.name))
    episodes = job.drive(env)
    return CellResult(episodes, round(time.process_time() - start, 3))


def read_results(folder: Path, cells: Sequence[Cell]) -> dict[Cell, CellResult]:
    """Read the finished cells of a folder. A line that is cut or damaged is left out."""
    # It is there once a cell is finished.
    file = folder / CELLS_FILE
    lines = reading.read_file(file, MAX_FILE_BYTES).splitlines() if file.exists() else []
    results: dict[Cell, CellResult] = {}
    for line in lines:
        with contextlib.suppress(ValueError, TypeError, LookupError, AttributeError):
            data = json.loads(line)
            (cell,) = [cell for cell in cells if cell.about.items() <= data.items()]
            episodes = [Episode(**values) for values in data["episodes"]]
            results[cell] = CellResult(episodes, data["seconds"], data["refused"])
    return results


def append_result(folder: Path, cell: Cell, result: CellResult) -> None:
    """Write a finished cell on a new line, in which NaN stays NaN. ConfigError on a full disk."""
    # A new line first: a write that was cut may have left half of one.
    file = folder / CELLS_FILE
    try:
        with file.open("a", encoding="utf-8") as stream:
            stream.write(f"\n{json.dumps(cell.about | asdict(result))}")
    except OSError as error:
        raise ConfigError(f"{file}: {explain_error(error)}") from error

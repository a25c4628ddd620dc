"""The held-out score of a policy that is being trained, and the learning curve of these scores."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.tools.evaluation.episode import Episode, describe_end
from acsar_gym.tools.evaluation.metrics import Summary, summarise_episodes
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import registry
from acsar_gym.worlds.pool import Pool

HELD_OUT_ROBOTS = 64
"""Robots in an evaluation during training; each runs one episode."""
TARGET_ROBOTS = 512
"""Robots in an evaluation that decides whether a target is reached."""
CURVE_FIGURES = {
    "success_rate": "success_rate",
    "collision_rate": "collision_rate",
    "struck_rate": "struck_rate",
    "mean_return": "episode_return",
    "mean_length": "length",
}
"""Columns of the curve that are figures of the held-out episodes, and names in a `Summary`."""
CURVE_COLUMNS = ("steps", "seconds", *CURVE_FIGURES)
"""`seconds` since the start of the training."""
CURVE_NAME = "learning_curve"
DRAWN_COLUMNS = {"success_rate": "success", "mean_return": "return", "collision_rate": "collisions"}
AXES = {"steps": "env steps", "seconds": "time [s]"}
Row = dict[str, float]
Decide = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Maps observations (n, m) to actions (n, 2); a state starts at its first call."""


def evaluate_held_out(batch: RobotVectorEnv, decide: Decide) -> Summary:
    """Run the first episode of every robot to its end, always from the same seeds.

    The batch needs a time limit. One episode per robot avoids a bias: the first n finished
    episodes of a batch would contain too many quick ones.

    Returns:
        Rates and means over the episodes; of their figures, only returns and lengths.
    """
    observations, _ = batch.reset(seed=FIRST_HELD_OUT_SEED)
    running = np.ones(batch.num_envs, np.bool_)
    returns = np.zeros(batch.num_envs)
    lengths = np.zeros(batch.num_envs, np.int64)
    episodes = []

    while running.any():
        observations, rewards, terminated, truncated, info = batch.step(decide(observations))
        returns += rewards * running
        lengths += running

        ended = running & (terminated | truncated)
        for robot in np.flatnonzero(ended):
            end = {key: row[robot] for key, row in info.items() if not key.startswith("_")}
            episode = Episode(
                seed=FIRST_HELD_OUT_SEED + int(robot),
                **describe_end(end),
                length=int(lengths[robot]),
                episode_return=float(returns[robot]),
            )
            episodes.append(episode)
        running &= ~ended
    return summarise_episodes(episodes)


def curve_figures(score: Summary) -> Row:
    """Return the figures of held-out episodes by the names of the curve's columns."""
    return {column: getattr(score, name) for column, name in CURVE_FIGURES.items()}


def success_label(batch: RobotVectorEnv) -> str:
    """Return the label of a success rate measured with this batch."""
    if batch.pool is None or batch.pool.generated:  # None: other goals on the open floor
        return "held-out success"
    return "success in the same worlds, other seeds"


def describe_worlds(training: RobotVectorEnv, held_out: RobotVectorEnv) -> str:
    """Describe the worlds of training and evaluation in one line."""
    pool = held_out.pool
    if pool is None:
        return "training on an open floor, held out: other seeds"
    worlds = f"held out: {pool}" if pool.generated else "evaluated in the same worlds, other seeds"
    return f"training in {training.pool}, {worlds}"


def choose_held_out_worlds(pool: Pool | None, robots: int = HELD_OUT_ROBOTS) -> list[str] | None:
    """Choose held-out worlds.

    Returns:
        For each set of generated worlds a set of the same generator without any of its worlds:
        those of the validation split, or those behind the set's if it has some of them. None for
        files and an open floor, which have no others, so that only the seeds differ.
    """
    if pool is None or not pool.generated:
        return None
    names = []
    count = robots // len(pool.sets)
    for group in pool.sets:
        split = registry.split_numbers(group.kind, registry.VALIDATION)
        overlaps = group.numbers[0] <= split[-1] and group.numbers[-1] >= split[0]
        first = group.numbers[-1] + 1 if overlaps else split[0]
        names.append(f"{group.generator}:{first}-{first + count - 1}")
    return names


class Curve:
    """The learning curve, a CSV file in the folder of a training.

    Args:
        folder: Folder of the training; None keeps the rows in memory only.
        most_steps: Rows of more steps are removed, which a training that goes on repeats.
    """

    def __init__(self, folder: Path | None = None, most_steps: int = 0) -> None:
        self._file = None if folder is None else folder / f"{CURVE_NAME}.csv"
        self.rows: list[Row] = []
        if self._file is not None and self._file.exists():
            with self._file.open(encoding="utf-8") as file:
                rows = [
                    {name: float(value) for name, value in row.items()}
                    for row in csv.DictReader(file)
                ]
            self.rows = [row for row in rows if row["steps"] <= most_steps]
            self._write()

    def append(self, row: Row) -> None:
        """Append a row; it replaces that of the same steps, which an update has outdated."""
        self.rows = [old for old in self.rows if old["steps"] != row["steps"]]
        self.rows.append(row)
        self._write()

    def _write(self) -> None:
        """Write the file, all of it or nothing."""
        if self._file is None:
            return
        with reading.replace_file(self._file) as new, new.open("w", encoding="utf-8") as file:
            writer = csv.DictWriter(file, CURVE_COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows({**row, "steps": int(row["steps"])} for row in self.rows)

    def draw(self, title: str) -> None:
        """Draw success, return and collisions over steps and over time, beside the file."""
        if self._file is not None and self.rows:
            draw_curve(self._file.with_suffix(".png"), self.rows, title)


def draw_curve(path: Path, rows: Sequence[Mapping[str, float]], title: str) -> None:
    """Draw success, return and collisions over steps and over time as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - optional, slow
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    plots = figure.subplots(len(DRAWN_COLUMNS), len(AXES), sharey="row", sharex="col")
    for line, column in zip(plots, DRAWN_COLUMNS, strict=True):
        for plot, axis in zip(line, AXES, strict=True):
            plot.plot([row[axis] for row in rows], [row[column] for row in rows], marker=".")
            plot.set(xlabel=AXES[axis], ylabel=DRAWN_COLUMNS[column])
            plot.grid(visible=True)
            plot.label_outer()
    with reading.replace_file(path) as new:
        figure.savefig(new, format="png", dpi=100)

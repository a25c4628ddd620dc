"""The held-out score of a policy that is being trained, and the learning curve of these scores."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.tools.evaluation.episode import Episode, describe_end
from acsar_gym.tools.evaluation.metrics import Summary, summarise_episodes
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import registry
from acsar_gym.worlds.pool import Pool

HELD_OUT_ROBOTS = 64
"""Robots in an evaluation during training; each runs one episode."""
TARGET_ROBOTS = 512
"""Robots in an evaluation that decides whether a target is reached."""
FIRST_HELD_OUT_SEED = 2**32
"""First seed of held-out episodes; seeds of a training are smaller."""
CURVE_FIGURES = {
    "success_rate": "success_rate",
    "collision_rate": "collision_rate",
    "struck_rate": "struck_rate",
    "mean_return": "episode_return",
    "mean_length": "length",
}
"""Columns of the curve that are figures of the held-out episodes, and names in a `Summary`."""
CURVE_COLUMNS = ("steps", "seconds", *CURVE_FIGURES)
"""`seconds` since the beginning of the training."""
Rows = list[dict[str, float]]
_SHOWN = {"success_rate": "success", "mean_return": "return", "collision_rate": "collisions"}
_AXES = {"steps": "env steps", "seconds": "time [s]"}
Decide = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Maps observations (n, m) to actions (n, 2); one that has a state begins at its first call."""


def evaluate_held_out(batch: RobotVectorEnv, decide: Decide) -> Summary:
    """Run the first episode of every robot to its end, always from the same seeds.

    The batch needs a time limit. One episode per robot avoids a bias: the first n finished
    episodes of a batch would contain too many quick ones.

    Returns:
        Rates and means over the episodes; of their figures, returns and lengths alone.
    """
    observations, _ = batch.reset(seed=FIRST_HELD_OUT_SEED)
    running = np.ones(batch.num_envs, np.bool_)
    returns, lengths = np.zeros(batch.num_envs), np.zeros(batch.num_envs, np.int64)
    episodes = []
    while running.any():
        observations, rewards, terminated, truncated, info = batch.step(decide(observations))
        returns += rewards * running
        lengths += running
        ended = running & (terminated | truncated)
        for robot in np.flatnonzero(ended):
            own = {key: row[robot] for key, row in info.items() if not key.startswith("_")}
            episodes.append(
                Episode(
                    seed=FIRST_HELD_OUT_SEED + int(robot),
                    **describe_end(own),
                    length=int(lengths[robot]),
                    episode_return=float(returns[robot]),
                )
            )
        running &= ~ended
    return summarise_episodes(episodes)


def curve_figures(score: Summary) -> dict[str, float]:
    """Return the figures of held-out episodes by the names of the curve's columns."""
    return {column: getattr(score, name) for column, name in CURVE_FIGURES.items()}


def as_metrics(score: Summary | None) -> dict[str, dict[str, float]]:
    """What a policy's bundle says of a score; nothing where there is none."""
    return {"held_out": {"episodes": score.episodes, **curve_figures(score)}} if score else {}


def success_label(batch: RobotVectorEnv) -> str:
    """Return the label of a success rate measured with this batch."""
    pool = batch.pool  # None: other goals on the open floor
    if pool is None or pool.generated:
        return "held-out success"
    return "success in the same worlds, other seeds"


def describe_worlds(learning: RobotVectorEnv, batch: RobotVectorEnv) -> str:
    """Describe the worlds of training and evaluation in one line."""
    pool = batch.pool
    if pool is None:
        return "training on an open floor, held out: other seeds"
    apart = f"held out: {pool}" if pool.generated else "evaluated in the same worlds, other seeds"
    return f"training in {learning.pool}, {apart}"


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


def write_curve(path: Path, rows: Rows) -> None:
    """Write the curve as CSV, whole or not at all."""
    with reading.replace_file(path) as new, new.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, CURVE_COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def draw_curve(path: Path, rows: Rows, title: str) -> None:
    """Draw success, return and collisions over steps and over time as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - optional, slow
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    places = figure.subplots(len(_SHOWN), len(_AXES), sharey="row", sharex="col")
    for line, column in zip(places, _SHOWN, strict=True):
        for place, axis in zip(line, _AXES, strict=True):
            place.plot([row[axis] for row in rows], [row[column] for row in rows], marker=".")
            place.set(xlabel=_AXES[axis], ylabel=_SHOWN[column])
            place.grid(visible=True)
            place.label_outer()
    with reading.replace_file(path) as new:
        figure.savefig(new, format="png", dpi=100)

"""The learning curve of a training: CSV while it runs, and a picture at its end."""

from __future__ import annotations

import csv
from pathlib import Path

from acsar_gym.reading import bounded

COLUMNS = ("steps", "seconds", "success_rate", "collision_rate", "mean_return", "mean_length")
"""`seconds` since the beginning of the training, all others of the held-out episodes."""
Rows = list[dict[str, float]]
_SHOWN = {"success_rate": "success", "mean_return": "return", "collision_rate": "collisions"}
_AXES = {"steps": "env steps", "seconds": "time [s]"}


def write(path: Path, rows: Rows) -> None:
    """Write the curve as CSV, whole or not at all."""
    with bounded.replacing(path) as new, new.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def draw(path: Path, rows: Rows, title: str) -> None:
    """Draw success, return and collisions over steps and over time as PNG.

    Args:
        path: file to write.
        rows: the curve; at least one row.
        title: what was trained.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - optional, slow
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    places = figure.subplots(len(_SHOWN), len(_AXES), sharey="row", sharex="col")
    for line, (column, label) in enumerate(_SHOWN.items()):
        for side, (axis, name) in enumerate(_AXES.items()):
            place = places[line][side]
            place.plot([row[axis] for row in rows], [row[column] for row in rows], marker=".")
            place.grid(visible=True)
            if column.endswith("_rate"):
                place.set_ylim(-0.02, 1.02)
            if side == 0:
                place.set_ylabel(label)
            if line == len(_SHOWN) - 1:
                place.set_xlabel(name)
    with bounded.replacing(path) as new:
        figure.savefig(new, format="png", dpi=100)

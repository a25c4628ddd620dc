"""What `acsar-gym worlds` does: draw worlds, check them, and convert their files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from acsar_gym import pictures
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds import World, difficulty, files
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, path_length, shortest_path

MOST_DRAWN = 100
"""Worlds on one sheet."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check says of one world; NaN where it can't be known. Lengths in m."""

    name: str
    obstacles: int
    path: float
    """Length of the world's own path."""
    shortest: float
    """Length of a shortest way for the robot's footprint."""
    closest_obstacle: float
    visibility: float
    dispersion: float
    characteristic_dimension: float
    tortuosity: float
    fault: str
    """Why the world can't be used; empty where it can."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON: NaN and infinity become None."""
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(self).items()
        }


def raw(source: str, level: float | None, robot: str | None, count: int) -> list[World]:
    """The worlds that a kind, a file or a folder names, as they are. Raises WorldError."""
    path = Path(source)
    if path.is_dir():
        return files.load_folder(path)
    if path.is_file() or path.suffix or "/" in source:
        return [files.load(path)]
    return list(Pool.of(source, level, footprint_radius(RobotConfig.of(robot)), count))


def draw(worlds: Sequence[World], columns: int, size: int, out: Path) -> None:
    """A sheet of worlds, or one alone, as a PNG file."""
    if len(worlds) > MOST_DRAWN:
        raise ConfigError(f"{len(worlds)} worlds are too many for a sheet, at most {MOST_DRAWN}")
    columns = min(columns, len(worlds))
    pictures.save(pictures.sheet(worlds, columns, size), out)


def check(worlds: Sequence[World], robot: str | None) -> list[Finding]:
    """Whether a robot can cross each world, how far it is, and how hard by BARN's measures."""
    radius = footprint_radius(RobotConfig.of(robot))
    return [_checked(world, radius) for world in worlds]


def _checked(world: World, radius: float) -> Finding:
    shortest, hard, fault = math.nan, difficulty.Difficulty(*[math.nan] * 5), ""
    try:
        way = shortest_path(world, radius)
        shortest, hard = path_length(way), difficulty.measure(world, way)
    except WorldError as error:
        fault = str(error).removeprefix(f"{world.name}: ")
    return Finding(
        name=world.name,
        obstacles=world.obstacles,
        path=world.length,
        shortest=shortest,
        **asdict(hard),
        fault=fault,
    )


def convert(source: str, out: Path, level: float | None, robot: str | None) -> None:
    """Write one world to the project's own .json or .yaml."""
    worlds = raw(source, level, robot, 1)
    if len(worlds) != 1:
        raise ConfigError(
            f"{source} holds {len(worlds)} worlds: name one file, or one like barn:7-7"
        )
    files.save(worlds[0], out)


def table(findings: Sequence[Finding]) -> Table:
    """One row a world."""
    drawn = Table(title="worlds: lengths in m, difficulty along the shortest way")
    drawn.title_justify = "left"
    drawn.add_column("world")
    columns = ("obstacles", "path", "shortest", "closest", "visibility", "dispersion", "width")
    for column in (*columns, "tortuosity"):
        drawn.add_column(column, justify="right")
    for f in findings:
        if f.fault:
            drawn.add_row(
                escape(f.name), str(f.obstacles), _short(f.path), f"[red]{escape(f.fault)}"
            )
            continue
        numbers = (f.path, f.shortest, f.closest_obstacle, f.visibility, f.dispersion)
        drawn.add_row(
            escape(f.name),
            str(f.obstacles),
            *map(_short, (*numbers, f.characteristic_dimension, f.tortuosity)),
        )
    return drawn


def _short(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

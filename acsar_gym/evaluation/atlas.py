"""What `acsar-gym worlds` does: draw worlds, check them, and convert their files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.evaluation import report
from acsar_gym.render import top_view as pictures
from acsar_gym.worlds import World, difficulty, files, names
from acsar_gym.worlds.pool import Pool, read
from acsar_gym.worlds.search import footprint_radius, path_length, shortest_path

MOST_DRAWN = 100
"""Worlds on one sheet."""
MOST_AT_ONCE = 10_000
"""Worlds that are made or read for one command."""


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


def raw(
    source: str, level: float | None, robot: str | None, count: int, most: int = MOST_AT_ONCE
) -> list[World]:
    """The worlds that a kind, a file or a folder names, as they are.

    Raises WorldError for what can't be read or made, and ConfigError for more than `most`.
    """
    given = read(source)
    if given is not None:
        _check_count(source, len(given), most)
        return given
    pool = Pool.of(source, level, footprint_radius(RobotConfig.of(robot)), count)
    _check_count(source, len(pool), most)
    return list(report.watched("making worlds", pool, len(pool)))


def told(source: str, count: int) -> dict[str, str | None]:
    """For a title and JSON: `source`, such as "clutter 0 to 199 (test split)", and the `split`.

    That's None where the worlds aren't all of one.
    """
    if names.generated(source) is None:
        return {"source": source, "split": None}
    pool = Pool.of(source, count=count)
    return {"source": str(pool), "split": pool.split or None}


def _check_count(source: str, count: int, most: int) -> None:
    if count > most == 1:
        raise ConfigError(f"{source} holds {count:,} worlds: name one file, or one like barn:7-7")
    if count > most:
        raise ConfigError(f"{source}: {count:,} worlds are too many, at most {most:,} at once")


def most_drawn(columns: int, size: int, out: Path) -> int:
    """How many worlds fit on a sheet. ConfigError where none can be drawn, or `out` written."""
    most = pictures.most_tiles(columns, size)
    pictures.check_name(out)
    report.check_writable(out)
    return min(most, MOST_DRAWN)


def draw(worlds: Sequence[World], columns: int, size: int, out: Path) -> None:
    """A sheet of worlds, or one alone, as a PNG file."""
    _check_count("the sheet", len(worlds), MOST_DRAWN)
    columns = min(columns, len(worlds))
    watch = partial(report.watched, "drawing worlds", total=len(worlds))
    pictures.save(pictures.sheet(worlds, columns, size, watch), out)


def check(worlds: Sequence[World], robot: str | None) -> list[Finding]:
    """Whether a robot can cross each world, how far it is, and how hard by BARN's measures."""
    radius = footprint_radius(RobotConfig.of(robot))
    return [
        _checked(world, radius) for world in report.watched("checking worlds", worlds, len(worlds))
    ]


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
    report.check_writable(out)
    files.save(raw(source, level, robot, 1, 1)[0], out)


def table(source: str, findings: Sequence[Finding]) -> Table:
    """One row a world."""
    title = f"worlds: {source}; lengths in m, difficulty along the shortest way"
    drawn = Table(title=report.plain(title), title_justify="left")
    drawn.add_column("world")
    columns = ("obstacles", "path", "shortest", "closest", "visibility", "dispersion", "width")
    for column in (*columns, "tortuosity"):
        drawn.add_column(column, justify="right")
    for f in findings:
        if f.fault:
            drawn.add_row(
                report.plain(f.name),
                str(f.obstacles),
                _short(f.path),
                f"[red]{report.plain(f.fault)}",
            )
            continue
        numbers = (f.path, f.shortest, f.closest_obstacle, f.visibility, f.dispersion)
        drawn.add_row(
            report.plain(f.name),
            str(f.obstacles),
            *map(_short, (*numbers, f.characteristic_dimension, f.tortuosity)),
        )
    return drawn


def _short(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

"""The command `acsar-gym worlds`: draws and checks worlds, and converts their files."""

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
from acsar_gym.render import top_view as pictures
from acsar_gym.tools.evaluation import report
from acsar_gym.worlds import World, difficulty, files, registry
from acsar_gym.worlds.pool import Pool, read_worlds
from acsar_gym.worlds.search import footprint_radius, path_length, shortest_path

MAX_DRAWN = 100
"""Most worlds on one sheet."""
MAX_AT_ONCE = 10_000
"""Most worlds that one command makes or reads."""


@dataclass(frozen=True, slots=True)
class WorldFinding:
    """Result of checking one world. Lengths in m; NaN for what couldn't be computed."""

    name: str
    obstacles: int
    path: float
    """Length of the path that comes with the world."""
    shortest: float
    """Length of the shortest path from start to goal for the robot's footprint."""
    closest_obstacle: float
    visibility: float
    dispersion: float
    characteristic_dimension: float
    tortuosity: float
    fault: str
    """Why the world can't be used; empty if it can."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; NaN and infinity become None."""
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(self).items()
        }


def collect_worlds(
    source: str, level: float | None, robot: str | None, count: int, most: int = MAX_AT_ONCE
) -> list[World]:
    """Read or generate worlds.

    Args:
        source: a generator such as "clutter" or "barn:0-9", or a file or folder of worlds.
        level: difficulty for a generator, 0 to 1; None for its default.
        robot: preset or file of the robot whose footprint generated worlds must let through.
        count: number of worlds to generate, where `source` names no numbers.
        most: largest number of worlds that is accepted.

    Returns:
        The worlds.

    Raises:
        WorldError: a world can't be read or generated.
        ConfigError: there are more than `most` worlds.
    """
    given = read_worlds(source)
    if given is not None:
        _check_count(source, len(given), most)
        return given
    pool = Pool.of(source, level, footprint_radius(RobotConfig.of(robot)), count)
    _check_count(source, len(pool), most)
    return list(report.watch_progress("making worlds", pool, len(pool)))


def describe_source(source: str, count: int) -> dict[str, str | None]:
    """Describe where worlds come from, for a title and for JSON.

    Args:
        source: as for `raw`.
        count: as for `raw`.

    Returns:
        `source`, such as "clutter 0 to 199 (test split)", and `split`: "train" or "test", None
        if the worlds aren't all of one split.
    """
    if registry.parse_known_name(source) is None:
        return {"source": source, "split": None}
    pool = Pool.of(source, count=count)
    return {"source": str(pool), "split": pool.split or None}


def _check_count(source: str, count: int, most: int) -> None:
    """Raise ConfigError for more than `most` worlds."""
    if count > most == 1:
        raise ConfigError(f"{source} holds {count:,} worlds: name one file, or one like barn:7-7")
    if count > most:
        raise ConfigError(f"{source}: {count:,} worlds are too many, at most {most:,} at once")


def max_drawn(columns: int, size: int, out: Path) -> int:
    """Return how many worlds fit on a sheet, before any of them is made.

    Args:
        columns: tiles in a row.
        size: width and height of a tile [pixels].
        out: PNG file to write.

    Raises:
        ConfigError: no world fits, or `out` can't be written.
    """
    most = pictures.max_tiles(columns, size)
    pictures.check_picture_name(out)
    report.check_writable(out)
    return min(most, MAX_DRAWN)


def draw_worlds(worlds: Sequence[World], columns: int, size: int, out: Path) -> None:
    """Draw worlds on one sheet and save it as a PNG file.

    Args:
        worlds: at most MOST_DRAWN.
        columns: tiles in a row.
        size: width and height of a tile [pixels].
        out: PNG file to write.

    Raises:
        ConfigError: too many worlds, or `out` can't be written.
    """
    _check_count("the sheet", len(worlds), MAX_DRAWN)
    columns = min(columns, len(worlds))
    watch = partial(report.watch_progress, "drawing worlds", total=len(worlds))
    pictures.save_picture(pictures.draw_sheet(worlds, columns, size, watch), out)


def check_worlds(worlds: Sequence[World], robot: str | None) -> list[WorldFinding]:
    """Check whether a robot can cross each world, and measure path lengths and BARN's difficulty.

    Args:
        worlds: the worlds.
        robot: preset or file of the robot whose footprint is used; None for the default robot.

    Returns:
        One finding per world.
    """
    radius = footprint_radius(RobotConfig.of(robot))
    return [
        _checked(world, radius)
        for world in report.watch_progress("checking worlds", worlds, len(worlds))
    ]


def _checked(world: World, radius: float) -> WorldFinding:
    """Check one world for a footprint of `radius` [m]."""
    shortest, hard, fault = math.nan, difficulty.Difficulty(*[math.nan] * 5), ""
    try:
        way = shortest_path(world, radius)
        shortest, hard = path_length(way), difficulty.measure_difficulty(world, way)
    except WorldError as error:
        fault = str(error).removeprefix(f"{world.name}: ")
    return WorldFinding(
        name=world.name,
        obstacles=world.obstacles,
        path=world.length,
        shortest=shortest,
        **asdict(hard),
        fault=fault,
    )


def convert_world(source: str, out: Path, level: float | None, robot: str | None) -> None:
    """Write one world to a file of this project's format, .json or .yaml.

    Args:
        source: as for `raw`; must name a single world.
        out: file to write.
        level: as for `raw`.
        robot: as for `raw`.

    Raises:
        WorldError: the world can't be read or generated.
        ConfigError: there are several worlds, or `out` can't be written.
    """
    report.check_writable(out)
    files.save_world(collect_worlds(source, level, robot, 1, 1)[0], out)


def findings_table(source: str, findings: Sequence[WorldFinding]) -> Table:
    """Format findings as a table with one row per world."""
    title = f"worlds: {source}; lengths in m, difficulty along the shortest way"
    drawn = Table(title=report.escape_text(title), title_justify="left")
    drawn.add_column("world")
    columns = ("obstacles", "path", "shortest", "closest", "visibility", "dispersion", "width")
    for column in (*columns, "tortuosity"):
        drawn.add_column(column, justify="right")
    for f in findings:
        if f.fault:
            drawn.add_row(
                report.escape_text(f.name),
                str(f.obstacles),
                _short(f.path),
                f"[red]{report.escape_text(f.fault)}",
            )
            continue
        numbers = (f.path, f.shortest, f.closest_obstacle, f.visibility, f.dispersion)
        drawn.add_row(
            report.escape_text(f.name),
            str(f.obstacles),
            *map(_short, (*numbers, f.characteristic_dimension, f.tortuosity)),
        )
    return drawn


def _short(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

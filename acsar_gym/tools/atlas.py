"""The command `acsar-gym worlds`: draws and checks worlds, and converts their files."""

from __future__ import annotations

import filecmp
import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, WorldError, show_value
from acsar_gym.render import top_view
from acsar_gym.render.canvas import check_picture_size
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.tile import draw_tile
from acsar_gym.worlds import World, files
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, lidar_height, path_length, shortest_path
from acsar_gym.worlds.sets import WorldSet

MAX_DRAWN = 100
"""Most worlds on one sheet."""
MAX_SHEET_PIXELS = 36_000_000
"""Largest size of a sheet [pixels], which is 100 MB."""
MAX_AT_ONCE = 10_000
"""Most worlds that one command makes or reads."""


def collect_worlds(
    source: str | Mapping[str, Any],
    level: float | None,
    robot: str | None,
    count: int,
    most: int = MAX_AT_ONCE,
) -> tuple[WorldSet, list[World]]:
    """Read or generate a set of worlds; a generator's name alone stands for its first `count`."""
    config = RobotConfig.of(robot)
    worlds = WorldSet.parse(source, level, alone=str(count), height=lidar_height(config))
    size = len(worlds.numbers)
    if size > most:
        name = source["path"] if isinstance(source, Mapping) else source
        raise ConfigError(
            f"{name} holds {size:,} worlds: name one file, or one like barn:7-7"
            if most == 1
            else f"{name}: {size:,} worlds are too many, at most {most:,} at once"
        )
    if worlds.worlds:  # unchecked, as a check reports what is wrong
        return worlds, list(worlds.worlds)
    pool = Pool([worlds], footprint_radius(config))
    return worlds, list(report.watch_progress("making worlds", pool, size))


def max_drawn(columns: int, size: int, out: Path) -> int:
    """Return how many worlds fit on a sheet, before any of them is made."""
    check_picture_size("size", (size, size))
    if columns < 1:
        raise ConfigError(f"columns = {show_value(columns)}: must be at least 1")
    top_view.check_picture_name(out)
    report.check_writable(out)
    return min(MAX_SHEET_PIXELS // size**2, MAX_DRAWN)


def draw_worlds(worlds: Sequence[World], columns: int, size: int, out: Path) -> None:
    """Draw worlds side by side as maps, x right and y up, and save them as a PNG file."""
    columns = min(columns, len(worlds))
    rows = math.ceil(len(worlds) / columns)
    if rows * columns * size**2 > MAX_SHEET_PIXELS:
        raise ConfigError(
            f"{len(worlds):,} worlds of {size} pixels are too many for a sheet in {columns} "
            f"columns: at most {max_drawn(columns, size, out):,}"
        )
    image = np.full((rows * size, columns * size, 3), top_view.FLOOR_COLOUR, np.uint8)
    for index, world in enumerate(report.watch_progress("drawing worlds", worlds, len(worlds))):
        row = size * (index // columns)
        column = size * (index % columns)
        image[row : row + size, column : column + size] = draw_tile(world, size)
    top_view.save_picture(image, out)


def describe_movers(worlds: Sequence[World]) -> str:
    """Describe what moves in worlds, on one line; empty where nothing does."""
    movers = [mover for world in worlds for mover in world.movers]
    if not movers:
        return ""
    counts = sorted({len(world.movers) for world in worlds})
    numbers = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else f"{counts[0]}"
    speeds = [mover.top_speed for mover in movers]
    reacting = [mover for mover in movers if mover.reacts]
    blind = sum(not mover.sees_robot for mover in reacting)
    how = f"{len(reacting)} of {len(movers)} react, {blind} of these don't see the robot"
    return (
        f"movers: {numbers} in a world, top speeds {min(speeds):.2f} to {max(speeds):.2f} m/s; "
        f"{how if reacting else 'none reacts'}"
    )


def check_worlds(worlds: Sequence[World], robot: str | None) -> list[dict[str, Any]]:
    """Check whether a robot can cross each world, and measure path lengths.

    Returns:
        For each world: `name`; number of `obstacles`; length of the `path` that is part of it, and
        of the `shortest` path for the robot's footprint [m]; `fault`, why it can't be used, empty
        if it can. NaN for what couldn't be computed.
    """
    radius = footprint_radius(RobotConfig.of(robot))
    findings = []
    for world in report.watch_progress("checking worlds", worlds, len(worlds)):
        shortest = math.nan
        fault = ""
        try:
            path = shortest_path(world, radius)
            shortest = path_length(path)
        except WorldError as error:
            fault = str(error).removeprefix(f"{world.name}: ")

        findings.append(
            {
                "name": world.name,
                "obstacles": world.obstacles,
                "path": world.length,
                "shortest": shortest,
                "fault": fault,
            }
        )
    return findings


def convert_world(
    source: str | Mapping[str, Any],
    out: Path,
    level: float | None,
    robot: str | None,
    *,
    force: bool = False,
) -> None:
    """Write one world to a file of this project's format, .json or .yaml.

    A file that has just this world is left as it is.
    """
    report.check_writable(out)
    _, (world,) = collect_worlds(source, level, robot, count=1, most=1)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / out.name
        files.save_world(world, copy)
        if out.is_file() and filecmp.cmp(copy, out, shallow=False):
            return
    reading.check_replaceable(out, mark="", force=force)  # people draw in their worlds
    files.save_world(world, out)


def findings_table(source: str, findings: Sequence[Mapping[str, Any]]) -> Table:
    """Format findings as a table with one row per world."""
    table = Table(title=report.escape_text(f"worlds: {source}"), title_justify="left")
    table.add_column("world")
    for column in ("obstacles", "path [m]", "shortest [m]"):
        table.add_column(report.escape_text(column), justify="right")
    for finding in findings:
        fault = finding["fault"]
        table.add_row(
            report.escape_text(finding["name"]),
            str(finding["obstacles"]),
            _format_length(finding["path"]),
            f"[red]{report.escape_text(fault)}" if fault else _format_length(finding["shortest"]),
        )
    return table


def _format_length(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

"""The command `acsar-gym worlds`: draws and checks worlds, and converts their files."""

from __future__ import annotations

import filecmp
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
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
from acsar_gym.worlds import World, files, registry
from acsar_gym.worlds.difficulty import Difficulty, measure_difficulty
from acsar_gym.worlds.pool import Pool, read_worlds
from acsar_gym.worlds.search import footprint_radius, lidar_height, path_length, shortest_path

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
) -> list[World]:
    """Read or generate worlds."""
    config = RobotConfig.of(robot)
    worlds: list[World] | Pool | None = read_worlds(source, lidar_height(config))
    if worlds is None:
        worlds = Pool.of(source, level, footprint_radius(config), count)
    if len(worlds) > most:
        source = source["path"] if isinstance(source, Mapping) else source
        raise ConfigError(
            f"{source} holds {len(worlds):,} worlds: name one file, or one like barn:7-7"
            if most == 1
            else f"{source}: {len(worlds):,} worlds are too many, at most {most:,} at once"
        )
    if isinstance(worlds, Pool):
        return list(report.watch_progress("making worlds", worlds, len(worlds)))
    return worlds


def describe_source(source: str, count: int) -> dict[str, str | None]:
    """Describe where worlds come from, for a title and for JSON."""
    if registry.parse_known_name(source) is None:
        return {"source": source, "split": None}
    pool = Pool.of(source, count=count)
    return {"source": str(pool), "split": pool.split or None}


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
    rows = -(-len(worlds) // columns)
    if rows * columns * size**2 > MAX_SHEET_PIXELS:
        raise ConfigError(
            f"{len(worlds):,} worlds of {size} pixels are too many for a sheet in {columns} "
            f"columns: at most {max_drawn(columns, size, out):,}"
        )
    image = np.full((rows * size, columns * size, 3), top_view.FLOOR_COLOUR, np.uint8)
    for index, world in enumerate(report.watch_progress("drawing worlds", worlds, len(worlds))):
        top, left = size * (index // columns), size * (index % columns)
        image[top : top + size, left : left + size] = draw_tile(world, size)
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
    """Check whether a robot can cross each world; measure path lengths and BARN's difficulty.

    Returns:
        For each world: `name`; number of `obstacles`; length of the `path` that comes with it, and
        of the `shortest` one for the robot's footprint [m]; the fields of `Difficulty`; `fault`,
        why it can't be used, empty if it can. NaN for what couldn't be computed.
    """
    radius = footprint_radius(RobotConfig.of(robot))
    findings = []
    for world in report.watch_progress("checking worlds", worlds, len(worlds)):
        shortest, difficulty, fault = math.nan, Difficulty(*[math.nan] * 5), ""
        try:
            path = shortest_path(world, radius)
            shortest, difficulty = path_length(path), measure_difficulty(world, path)
        except WorldError as error:
            fault = str(error).removeprefix(f"{world.name}: ")
        lengths = {"path": world.length, "shortest": shortest}
        about = {"name": world.name, "obstacles": world.obstacles}
        findings.append({**about, **lengths, **asdict(difficulty), "fault": fault})
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
    world = collect_worlds(source, level, robot, 1, 1)[0]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / out.name
        files.save_world(world, copy)
        if out.is_file() and filecmp.cmp(copy, out, shallow=False):
            return
    reading.check_replaceable(out, mark="", force=force)  # people draw in their worlds
    files.save_world(world, out)


def findings_table(source: str, findings: Sequence[Mapping[str, Any]]) -> Table:
    """Format findings as a table with one row per world."""
    title = f"worlds: {source}; lengths in m, difficulty along the shortest way"
    table = Table(title=report.escape_text(title), title_justify="left")
    table.add_column("world")
    columns = ("obstacles", "path", "shortest", "closest", "visibility", "dispersion", "width")
    for column in (*columns, "tortuosity"):
        table.add_column(column, justify="right")
    for finding in findings:
        name, obstacles, path, *others, fault = finding.values()
        cells = [f"[red]{report.escape_text(fault)}"] if fault else map(_format_length, others)
        table.add_row(report.escape_text(name), str(obstacles), _format_length(path), *cells)
    return table


def _format_length(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

"""The commands `acsar-gym worlds`: draw and check worlds, and convert their files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.render import top_view
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.tile import draw_tile
from acsar_gym.worlds import World
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, lidar_height, path_length, shortest_path
from acsar_gym.worlds.sets import WorldSet

MAX_DRAWN = 100
"""Most worlds on a sheet, which then has 10 million pixels."""
MAX_AT_ONCE = 10_000
"""Most worlds that a command makes or reads."""
COLUMNS = 4
"""Worlds next to each other on a sheet."""
TILE_SIZE = 320
"""Width and height of each world [pixels]."""


def collect_worlds(
    source: str | Mapping[str, Any],
    difficulty: float | None,
    robot: str | None,
    count: int,
    most: int = MAX_AT_ONCE,
) -> tuple[WorldSet, list[World]]:
    """Read or generate a set of worlds. A generator's name alone means its first `count`."""
    config = RobotConfig.of(robot)
    worlds = WorldSet.parse(source, difficulty, alone=str(count), height=lidar_height(config))
    size = len(worlds.numbers)
    if size > most:
        name = source["path"] if isinstance(source, Mapping) else source
        raise ConfigError(f"{name}: {size:,} worlds are too many, at most {most:,} here")
    if worlds.worlds:  # without checks, since `check_worlds` reports what is wrong
        return worlds, list(worlds.worlds)
    pool = Pool([worlds], footprint_radius(config))
    return worlds, list(report.watch_progress("making worlds", pool, size))


def draw_worlds(worlds: Sequence[World], out: Path) -> None:
    """Draw worlds next to each other as maps, x right and y up, and save them as a PNG file."""
    columns = min(COLUMNS, len(worlds))
    rows = math.ceil(len(worlds) / columns)
    image = np.full((rows * TILE_SIZE, columns * TILE_SIZE, 3), top_view.FLOOR_COLOUR, np.uint8)
    for index, world in enumerate(report.watch_progress("drawing worlds", worlds, len(worlds))):
        row = TILE_SIZE * (index // columns)
        column = TILE_SIZE * (index % columns)
        image[row : row + TILE_SIZE, column : column + TILE_SIZE] = draw_tile(world, TILE_SIZE)
    top_view.save_picture(image, out)


def check_worlds(worlds: Sequence[World], robot: str | None) -> list[dict[str, Any]]:
    """Check whether a robot can cross each world, and measure path lengths.

    Returns:
        For each world: `name`. Number of `obstacles`. Length of the `path` that is part of it, and
        of the `shortest` path for the robot's footprint [m]. `fault`, why it can't be used, empty
        if it can. None for what couldn't be computed.
    """
    radius = footprint_radius(RobotConfig.of(robot))
    findings = []
    for world in report.watch_progress("checking worlds", worlds, len(worlds)):
        shortest = None
        fault = ""
        try:
            shortest = path_length(shortest_path(world, radius))
        except WorldError as error:
            fault = str(error).removeprefix(f"{world.name}: ")

        findings.append(
            {
                "name": world.name,
                "obstacles": world.obstacles,
                "path": world.length if math.isfinite(world.length) else None,
                "shortest": shortest,
                "fault": fault,
            }
        )
    return findings


def findings_table(source: str, findings: Sequence[Mapping[str, Any]]) -> Table:
    """Format findings as a table with a row for each world."""
    rows = [
        {
            "world": finding["name"],
            "obstacles": str(finding["obstacles"]),
            "path [m]": _format_length(finding["path"]),
            "shortest [m]": finding["fault"] or _format_length(finding["shortest"]),
        }
        for finding in findings
    ]
    return report.make_table(f"worlds: {source}", rows, texts=("world",))


def _format_length(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"

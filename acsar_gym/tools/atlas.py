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
MAX_TITLE = 28
"""Longest name on a world's picture [characters]."""


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


def draw_worlds(worlds: Sequence[World], out: Path, robot: str | None = None) -> None:
    """Draw worlds next to each other, with the robot at their starts, and save a PNG file."""
    view = top_view.TopView(RobotConfig.of(robot), (TILE_SIZE, TILE_SIZE))
    columns = min(COLUMNS, len(worlds))
    rows = math.ceil(len(worlds) / columns)
    image = np.full((rows * TILE_SIZE, columns * TILE_SIZE, 3), top_view.FLOOR_COLOUR, np.uint8)
    for index, world in enumerate(report.watch_progress("drawing worlds", worlds, len(worlds))):
        start = world.start
        movers = [(*m.position(0.0), *m.velocity(0.0), m.radius) for m in world.movers]
        frame = top_view.TopViewFrame(
            world=world,
            odom=(start.x, start.y, start.theta or 0.0),
            goal=(world.goal.x, world.goal.y),
            goal_radius=world.goal.radius,
            movers=np.reshape(movers, (-1, 5)),
            caption=world.name[:MAX_TITLE],
        )

        # Tiles fill the sheet row by row.
        row = TILE_SIZE * (index // columns)
        column = TILE_SIZE * (index % columns)
        image[row : row + TILE_SIZE, column : column + TILE_SIZE] = view.draw(frame)
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
        # A world that can't be crossed is a finding, not an error.
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

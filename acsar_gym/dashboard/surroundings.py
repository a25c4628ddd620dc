"""The world of a simulated episode, and where the LiDAR has seen something."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.dashboard.columns import Floats, evenly
from acsar_gym.dashboard.episodes import Episode
from acsar_gym.errors import AcsarError
from acsar_gym.lidars.base import ray_spec
from acsar_gym.worlds import World, names
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

SCANS = 60
"""Scans whose points are drawn as what was seen so far."""
CELL = 0.05
"""Points in one square of this side are drawn as one [m]."""
CORNERS = 24
"""Corners of a circle that is drawn."""
NO_POINTS = np.zeros((0, 2))


def world_of(header: dict[str, Any], config: RobotConfig, episode: Episode) -> World | None:
    """Return the world of a simulated episode; None where it isn't known.

    Only worlds of this package's own generators are made again: a recording may name any module.

    Args:
        header: of the recording.
        config: of the robot.
        episode: with the world's number.
    """
    env = header.get("about", {}).get("env")
    options = env.get("kwargs") if isinstance(env, dict) else None
    if not isinstance(options, dict):
        return None
    source, number = options.get("worlds"), episode.info.get("world")
    name = names.parsed(source) if isinstance(source, str) else None
    if not (episode.is_simulated and name and not name.module and isinstance(number, int)):
        return None
    try:
        level = options.get("difficulty")
        return Pool.of(str(source), level, footprint_radius(config))[number]
    except (AcsarError, TypeError, ValueError):
        return None


def shapes(world: World, start: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return what to draw of a world, in the odometry frame that begins at `start`.

    Returns:
        Corners of the circles and ends of the segments, (n, 2) each, with rows of NaN between.
    """
    turns = np.linspace(0.0, math.tau, CORNERS)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    circles = [circle[:2] + circle[2] * ring for circle in world.circles]
    segments = list(world.segments.reshape(-1, 2, 2))
    return _placed(circles, start), _placed(segments, start)


def _placed(lines: list[Floats], start: tuple[float, float, float]) -> Floats:
    """Lines in the frame of the world, in the odometry frame, NaN between them."""
    if not lines:
        return NO_POINTS
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([part for line in lines for part in (line, gap)]) - start[:2]
    cos, sin = math.cos(start[2]), math.sin(start[2])
    return np.stack([points @ (cos, sin), points @ (-sin, cos)], axis=1)


def seen(episode: Episode, config: RobotConfig, time: float) -> tuple[Floats, Floats]:
    """Return where the LiDAR has seen something, in the odometry frame.

    Args:
        episode: with the scans.
        config: of the robot.
        time: until when [s].

    Returns:
        Points of the newest scan, and of those before it, (n, 2) and (m, 2) [m].
    """
    count = int(np.searchsorted(episode.scans.rows[:, 0], time + 1e-9, "right"))
    if not count or episode.ranges is None or not len(episode.ticks):
        return NO_POINTS, NO_POINTS
    chosen = evenly(count, SCANS)
    points = _hits(episode, config, chosen)
    newest, before = points[-1], np.concatenate([NO_POINTS, *points[:-1]])
    cells: Floats = np.unique(np.round(before / CELL), axis=0)
    return newest, cells * CELL


def _hits(episode: Episode, config: RobotConfig, scans: Any) -> list[Floats]:
    """Points that each of some scans hit, in the odometry frame."""
    assert episode.ranges is not None  # noqa: S101 - checked by `seen`
    stamps, ticks = episode.scans.rows[scans, 0], episode.column("stamp")
    x, y = (np.interp(stamps, ticks, episode.column(name)) for name in ("x", "y"))
    heading = np.interp(stamps, ticks, np.unwrap(episode.column("theta")))
    spec = ray_spec(config)
    found: list[Floats] = []
    angles = spec.angles() if spec.rays == episode.ranges.rows.shape[1] else None
    for place, row in enumerate(episode.ranges.rows[scans].astype(np.float64)):
        if angles is None:
            break
        hit = np.isfinite(row) & (row < config.lidar.max_range) & (row > 0.0)
        ahead = config.lidar_x_offset + row[hit] * np.cos(angles[hit])
        left = config.lidar_y_offset + row[hit] * np.sin(angles[hit])
        cos, sin = math.cos(heading[place]), math.sin(heading[place])
        found.append(
            np.stack([x[place] + cos * ahead - sin * left, y[place] + sin * ahead + cos * left], 1)
        )
    return found or [NO_POINTS]

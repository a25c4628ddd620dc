"""The robot from above: path, goal, obstacles, and what its LiDAR sees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.dashboard import palette
from acsar_gym.dashboard.columns import Floats, evenly
from acsar_gym.dashboard.episodes import Episode
from acsar_gym.dashboard.palette import Figure
from acsar_gym.dashboard.surroundings import seen, shapes
from acsar_gym.worlds import World
from acsar_gym.worlds.scene import to_odometry

POINTS = 1500
"""Points of a path that are drawn."""
MARGIN, LEAST = 1.0, 4.0
"""Space around the path, and smallest side of the view [m]."""


def figure(
    episode: Episode, config: RobotConfig, world: World | None, time: float, revision: str
) -> Figure:
    """Draw an episode at a time since its reset [s]."""
    place, poses = episode.place(time), _poses(episode)
    now, before = seen(episode, config, time)
    traces = [palette.specks(before, palette.SEEN, 3, name="seen before")]
    traces += _world(world, episode)
    if episode.is_simulated:
        traces.append(_truth(episode, time))
    chosen, far = evenly(len(poses), POINTS), palette.SENT + "40"
    done = chosen[chosen <= place]
    traces.append(_path(poses[chosen], far, "path to come"))
    traces.append(
        _path(poses[np.r_[done, place]] if place >= 0 else poses[:0], palette.SENT, "path")
    )
    traces.append(palette.specks(now, palette.SCAN, 4, name="LiDAR now"))
    traces += _goal(episode)
    traces += _robot(config, tuple(poses[place]) if place >= 0 else (0.0, 0.0, 0.0))
    (left, right), (low, high) = _limits(episode, poses)
    return {
        "data": traces,
        "layout": palette.layout(
            revision,
            dragmode="pan",
            xaxis=palette.axis("x forward [m]", range=[left, right]),
            yaxis=palette.axis("y left [m]", range=[low, high], scaleanchor="x", scaleratio=1),
        ),
    }


def _poses(episode: Episode) -> Floats:
    """Poses by odometry, (n, 3)."""
    return np.stack([episode.column(name) for name in ("x", "y", "theta")], axis=1)


def _path(points: Floats, colour: str, name: str) -> Figure:
    """A path by odometry."""
    return palette.line(points[:, 0], points[:, 1], colour, name=name, line={"width": 2.5})


def _truth(episode: Episode, time: float) -> Figure:
    """The true path of a simulated robot, in the odometry frame."""
    rows = episode.truth.rows
    rows = rows[: int(np.searchsorted(rows[:, 0], time + 1e-9, "right"))]
    rows = rows[evenly(len(rows), POINTS // 3)]
    points = [to_odometry(episode.start, (x, y, theta))[:2] for x, y, theta in rows[:, 1:].tolist()]
    style = {"dash": "dot", "width": 1.6}
    track = np.array(points, np.float64).reshape(-1, 2)
    return palette.line(track[:, 0], track[:, 1], palette.TRUTH, name="true path", line=style)


def _world(world: World | None, episode: Episode) -> list[Figure]:
    """The obstacles of a simulated world."""
    if world is None:
        return []
    circles, segments = shapes(world, episode.start)
    style: dict[str, Any] = {
        "line": {"width": 1},
        "fill": "toself",
        "fillcolor": palette.WALL + "30",
    }
    walls: dict[str, Any] = {"line": {"width": 2}, "connectgaps": False}
    return [
        palette.line(circles[:, 0], circles[:, 1], palette.WALL, name="obstacles", **style),
        palette.line(segments[:, 0], segments[:, 1], palette.WALL, name="walls", **walls),
    ]


def _goal(episode: Episode) -> list[Figure]:
    """The goal, and the start."""
    start = palette.dots(np.zeros((1, 2)), palette.MUTED, 9, name="start")
    start["marker"] |= {"symbol": "cross-thin", "line": {"width": 2, "color": palette.MUTED}}
    if episode.goal is None:
        return [start]
    goal = palette.dots(np.array([episode.goal]), palette.GOAL + "33", 22, name="goal")
    goal["marker"]["line"] = {"width": 2.5, "color": palette.GOAL}
    return [start, goal]


def _robot(config: RobotConfig, pose: tuple[float, ...]) -> list[Figure]:
    """The footprint, and a line that shows where its front is."""
    x, y, theta = pose
    corners = np.array([*config.outline, config.outline[0]])
    ahead = float(corners[:, 0].max())
    turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    placed = corners @ turn + (x, y)
    front = np.array([(0.0, 0.0), (ahead, 0.0)]) @ turn + (x, y)
    fill: dict[str, Any] = {"fill": "toself", "fillcolor": palette.INK + "cc"}
    return [
        palette.line(placed[:, 0], placed[:, 1], palette.INK, name="robot", **fill),
        palette.line(front[:, 0], front[:, 1], "#ffffff", name="front", line={"width": 2.5}),
    ]


def _limits(episode: Episode, poses: Floats) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of x and y that hold path and goal, in whole steps so that they seldom change."""
    points = np.concatenate([np.zeros((1, 2)), poses[:, :2]])
    if episode.goal is not None:
        points = np.concatenate([points, [episode.goal]])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    more = np.maximum(LEAST - (high - low), 0.0) / 2.0
    low, high = np.floor(low - more).tolist(), np.ceil(high + more).tolist()
    return (low[0], high[0]), (low[1], high[1])

"""What an episode's path tells: lengths, turning, jerk, and the distance to obstacles.

`steps` are the infos of the reset and of every env step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config.footprint import Outline
from acsar_gym.envs.base import RobotEnv
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.clearance import clearance, segment_clearance
from acsar_gym.worlds.scene import point_in_world, to_world
from acsar_gym.worlds.search import footprint_radius, path_length, way_left

Steps = Sequence[dict[str, Any]]
Floats = NDArray[np.float64]


def poses(steps: Steps, frame: str) -> Floats:
    """Return the poses (N, 3) by odometry ("odom") or ground truth ("true") [m, m, rad].

    Both are in the odometry frame.
    """
    names = (f"{frame}_x", f"{frame}_y", f"{frame}_theta")
    return np.array([[step[name] for name in names] for step in steps], np.float64)


def length(steps: Steps, frame: str) -> float:
    """Return the length of the path driven in `frame` ("odom" or "true") [m]."""
    return path_length(poses(steps, frame)[:, :2])


def turning(steps: Steps) -> float:
    """Return the sum of absolute heading changes by odometry [rad]."""
    turns = np.diff(np.unwrap(poses(steps, "odom")[:, 2]))
    return float(np.abs(turns).sum())


def jerk(steps: Steps, period: float) -> float:
    """Compute the mean absolute jerk of the speed driven, by odometry.

    The average of |d^2 v / dt^2|, as in the metrics of Francis et al. 2023 (Principles and
    Guidelines for Evaluating Social Robot Navigation), by second differences of the speed. The
    speed of a step is its displacement along the mean heading, over the period.

    Args:
        steps: infos of the episode.
        period: duration of an env step [s].

    Returns:
        The jerk [m/s^3]; NaN for episodes of fewer than three steps.
    """
    if len(steps) < 4:
        return math.nan
    x, y, theta = poses(steps, "odom").T
    theta = np.unwrap(theta)
    middle = (theta[1:] + theta[:-1]) / 2.0
    speeds = (np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)) / period
    return float(np.abs(np.diff(speeds, 2)).mean()) / period**2


def ways(env: RobotEnv, steps: Steps) -> dict[str, float]:
    """Return lengths of the shortest, remaining and driven path [m], by ground truth if known."""
    frame = "odom" if math.isnan(steps[-1]["true_x"]) else "true"
    assignment = env.episode.assignment
    if assignment.path is not None:
        return {"driven": length(steps, frame)}
    if frame == "odom" and assignment.world is not None:
        return {"driven": length(steps, frame)}  # a real robot's surroundings aren't known
    radius, world = footprint_radius(env.robot.config), assignment.world or World()
    places = [(step[f"{frame}_x"], step[f"{frame}_y"]) for step in (steps[0], steps[-1])]
    *ends, goal = (
        Region(*point_in_world(assignment.start, place)) for place in (*places, assignment.goal)
    )
    shortest, left = (way_left(world, radius, end, goal) for end in ends)
    return {"shortest": shortest, "left": left, "driven": length(steps, frame)}


def least_clearance(env: RobotEnv, steps: Steps) -> float:
    """Return the least distance of the footprint to an obstacle at any step [m].

    By ground truth; 0 where the robot touched one, NaN without ground truth or obstacles.
    """
    assignment, last = env.episode.assignment, steps[-1]
    world = assignment.world
    if world is None or not world.obstacles or math.isnan(last["true_x"]):
        return math.nan
    if last["true_contact"] == 1.0:
        return 0.0
    places = np.array([to_world(assignment.start, pose) for pose in poses(steps, "true").tolist()])
    return max(0.0, footprint_clearance(places, env.robot.config.outline, world))


def footprint_clearance(places: Floats, outline: Outline, world: World) -> float:
    """Compute the least distance of a footprint, at any of several poses, to any obstacle.

    Args:
        places: poses of the base in the frame of the world, (N, 3) [m, m, rad].
        outline: corners of the footprint in the base frame [m].
        world: with the obstacles.

    Returns:
        The distance of the footprint's sides [m]: negative inside a circle, inf without obstacles.
    """
    corners = np.array(outline)
    outer, centres = float(np.hypot(*corners.T).max()), clearance(places[:, :2], world)
    near = places[centres <= centres.min() + outer]  # elsewhere the footprint is farther away
    x, y, theta = near.T[..., None]
    cos, sin = np.cos(theta), np.sin(theta)
    ahead, left = corners.T
    placed = np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left], axis=-1)
    ends = np.roll(placed, -1, axis=1)
    return float(segment_clearance(placed.reshape(-1, 2), ends.reshape(-1, 2), world).min())

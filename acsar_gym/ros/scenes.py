"""Scenes of simulated robots in ROS: the name of a world, such as clutter:7, and a start."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, WorldError
from acsar_gym.worlds import Pose, Region, Scene, World, registry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, lidar_height

_ONE_WORLD = re.compile(r"(.*:)?(\d+)")


def find_scene(name: str, start: Sequence[float], config: RobotConfig) -> Scene:
    """Return the scene of a world.

    Args:
        name: World such as "clutter:7", or a file. Empty for an open floor. If the name stands for
            several worlds ("clutter:test"), the first one is used.
        start: Start x [m], y [m] and theta [rad] in the frame of the world. Empty for the start of
            the world itself.
        config: Robot configuration. Worlds are made for its footprint.

    Raises:
        WorldError: There is no such world, or the start isn't three finite numbers.
    """
    if len(start) not in (0, 3) or not np.isfinite(start).all():
        raise WorldError(f"start = {list(start)}: must be x, y [m] and theta [rad], or empty")
    if not name:
        return Scene(_make_pose(start, Region(0.0, 0.0)))

    match = _ONE_WORLD.fullmatch(name)

    # A single world is a range of one.
    source = f"{name}-{match[2]}" if match and match[1] else name
    pool = Pool.of(source, None, footprint_radius(config), alone="1", height=lidar_height(config))
    world = next(iter(pool))
    return Scene(_make_pose(start, world.start), (world.goal.x, world.goal.y), world)


def _make_pose(start: Sequence[float], region: Region) -> Pose:
    """Return a start. That of a region if it is empty."""
    x, y, theta = start or (region.x, region.y, region.theta or 0.0)
    return (x, y, theta)


def name_world(world: World | None, config: RobotConfig) -> str:
    """Return the name by which `find_scene` finds a world. Empty for an open floor.

    Raises:
        LinkError: The world isn't a generated one with the default difficulty.
    """
    if world is None:
        return ""
    # Generators name their worlds by kind and number.
    kind, _, number = world.name.rpartition(" ")
    module = registry.home_module(kind)
    name = f"{module}:{kind}:{number}" if module else f"{kind}:{number}"

    # The driver makes the world again, which must be the same.
    try:
        named = find_scene(name, (), config).world
    except WorldError:
        named = None
    if named is None or not (
        np.array_equal(named.circles, world.circles)
        and np.array_equal(named.segments, world.segments)
    ):
        raise LinkError(
            f"world {world.name!r}: a simulated robot in ROS takes generated worlds only",
            "use worlds such as clutter:test without a difficulty, or evaluate with --link bullet",
        )
    return name

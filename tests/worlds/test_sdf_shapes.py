"""Outlines of bodies where the LiDAR meets them, against points inside of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from acsar_gym.worlds import sdf
from acsar_gym.worlds.sdf_shapes import LIDAR_HEIGHT

Inside = Callable[[Any], Any]
"""Whether points (n, 3) in a body's own frame are inside of it."""


def outline(
    shape: str, *pose: float, height: float = LIDAR_HEIGHT
) -> tuple[list[list[float]], list[list[float]]]:
    numbers = " ".join(map(str, pose))
    found = sdf.read_obstacles(
        f"<sdf version='1.9'><world name='w'><model name='m'><pose>{numbers}</pose><link name='l'>"
        f"<collision name='c'><geometry>{shape}</geometry></collision></link></model></world></sdf>"
        "".encode(),
        height=height,
    )
    return found.circles.tolist(), found.segments.tolist()


def is_in_cylinder(points: Any) -> Any:
    return (np.hypot(points[:, 0], points[:, 1]) <= 0.3) & (np.abs(points[:, 2]) <= 0.8)


def is_in_capsule(points: Any) -> Any:
    ends = points[:, 2] - np.clip(points[:, 2], -0.5, 0.5)
    return np.hypot(np.hypot(points[:, 0], points[:, 1]), ends) <= 0.2


def is_in_cone(points: Any) -> Any:
    share = 0.5 - points[:, 2] / 1.2
    return (np.hypot(points[:, 0], points[:, 1]) <= 0.4 * share) & (share <= 1.0)


SOLIDS: dict[str, tuple[str, Inside]] = {
    "box": (
        "<box><size>1.5 0.8 0.6</size></box>",
        lambda points: (np.abs(points) <= (0.75, 0.4, 0.3)).all(axis=1),
    ),
    "cylinder": ("<cylinder><radius>0.3</radius><length>1.6</length></cylinder>", is_in_cylinder),
    "capsule": ("<capsule><radius>0.2</radius><length>1</length></capsule>", is_in_capsule),
    "ellipsoid": (
        "<ellipsoid><radii>0.6 0.3 0.4</radii></ellipsoid>",
        lambda points: ((points / (0.6, 0.3, 0.4)) ** 2).sum(axis=1) <= 1.0,
    ),
    "cone": ("<cone><radius>0.4</radius><length>1.2</length></cone>", is_in_cone),
}
POSES = [
    (0.2, -0.1, 0.4, 0.0, math.pi / 2.0, 0.0),
    (0.2, -0.1, 0.5, math.pi / 2.0, 0.0, 1.0),
    (0.0, 0.0, 0.3, 2.0, 0.7, -1.0),
]


def rotation(roll: float, pitch: float, yaw: float) -> Any:
    """Of fixed axes, as SDF's poses."""

    def about(axis: int, angle: float) -> Any:
        one, other = (k for k in range(3) if k != axis)
        matrix = np.eye(3)
        matrix[one, one] = matrix[other, other] = math.cos(angle)
        matrix[other, one] = math.sin(angle) * (-1.0 if axis == 1 else 1.0)
        matrix[one, other] = -matrix[other, one]
        return matrix

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def polygon_distance(points: Any, segments: Any) -> Any:
    """How far points lie inside a convex ring of segments, counterclockwise [m]."""
    ring = np.array(segments)
    ways = ring[:, 2:] - ring[:, :2]
    ways = ways / np.hypot(*ways.T)[:, None]
    away = points[:, None, :] - ring[:, :2]
    return (ways[:, 0] * away[..., 1] - ways[:, 1] * away[..., 0]).min(axis=1)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", SOLIDS)
def test_a_tilted_body_counts_by_its_section_at_the_lidars_height(
    name: str, pose: tuple[float, ...]
) -> None:
    shape, is_inside = SOLIDS[name]
    circles, segments = outline(shape, *pose)
    assert circles == []
    grid = np.stack(np.meshgrid(*[np.arange(-1.2, 1.2, 0.02)] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.full(len(grid), LIDAR_HEIGHT)])
    inside = is_inside((points - pose[:3]) @ rotation(*pose[3:]))
    depth = polygon_distance(grid, segments)
    assert inside.sum() > 200
    assert not (inside & (depth < -0.012)).any(), "circles have 32 corners"
    assert not (~inside & (depth > 1e-6)).any()


def test_what_is_lower_than_the_lidar_counts_by_its_shadow() -> None:
    pipe = "<cylinder><radius>0.1</radius><length>2</length></cylinder>"
    _, segments = outline(pipe, 0.0, 0.0, 0.1, 0.0, math.pi / 2.0, 0.0)
    corners = np.array(segments)[:, :2]
    np.testing.assert_allclose(np.abs(corners).max(axis=0), [1.0, 0.1], atol=1e-6)
    log = "<capsule><radius>0.1</radius><length>2</length></capsule>"
    _, segments = outline(log, 0.0, 0.0, 0.1, 0.0, math.pi / 2.0, 0.0)
    corners = np.array(segments)[:, :2]
    np.testing.assert_allclose(np.abs(corners).max(axis=0), [1.1, 0.1], atol=1e-6)


@pytest.mark.parametrize(
    ("height", "z", "radius"),
    [
        (0.37, 0.5, 0.3),
        (0.37, 1.0, math.sqrt(0.3**2 - 0.23**2)),  # the lower cap
        (0.3, 0.9, math.sqrt(0.3**2 - 0.2**2)),
        (0.37, -0.35, 0.3),  # lower than the LiDAR, wide within reach
    ],
)
def test_an_upright_capsule_is_a_circle(height: float, z: float, radius: float) -> None:
    shape = "<capsule><radius>0.3</radius><length>0.8</length></capsule>"
    circles, segments = outline(shape, 1.0, 2.0, z, 0.0, 0.0, 0.7, height=height)
    np.testing.assert_allclose(circles, [[1.0, 2.0, radius]])
    assert segments == []

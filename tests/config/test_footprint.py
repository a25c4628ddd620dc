"""Outlines of robots: which are refused, and how far they reach."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.config.footprint import (
    border_distance,
    contains_point,
    make_circle,
    make_rectangle,
    outline_radius,
    outline_reach,
)
from acsar_gym.errors import ConfigError
from acsar_gym.worlds.search import footprint_radius

WEDGE = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
SQUARE = ((1, 1), (-1, 1), (-1, -1), (1, -1))
STAR = [(math.cos(k * 0.8 * math.pi), math.sin(k * 0.8 * math.pi)) for k in range(5)]
"""Five corners, of which each second is next: all turns are to the left, around it twice."""


@pytest.mark.parametrize(
    "corners", [SQUARE, SQUARE[::-1], (*SQUARE, SQUARE[0]), (*SQUARE, (1, 0.3)), make_circle(0.3)]
)
def test_footprint_is_taken_counterclockwise(corners: Any) -> None:
    outline = RobotConfig(footprint=corners).outline
    assert set(outline) == set(corners)
    (ax, ay), (bx, by) = outline[:2]
    assert ax * by - ay * bx > 0.0
    assert contains_point(outline, 0.1, 0.1)
    assert not contains_point(outline, 1.1, 0.1)


CONVEX = "footprint = .*: must be a convex polygon"


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (((1, 1), (-1, -1)), "footprint"),
        ((*SQUARE, (0.05, 0.0)), CONVEX),
        (STAR, CONVEX),
        (((1, 1), (-1, 1), (-3, 1), (-1, 1), (-1, -1), (1, -1)), CONVEX),  # a side that comes back
        (((2, 1), (1, 1), (1, -1), (2, -1)), "footprint"),  # the origin is outside
        ("[[1, 1], [-1, 1]", "footprint"),
    ],
)
def test_footprint_that_is_bad_is_an_error_that_names_the_field(corners: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        RobotConfig(footprint=corners)


def test_footprint_in_a_robots_file(tmp_path: Path) -> None:
    lists = json.dumps(WEDGE)
    (tmp_path / "wedge.yaml").write_text(f"footprint: {lists}\nwheelbase: 0.1\n")
    config = RobotConfig.load(tmp_path / "wedge.yaml")
    assert config.footprint == config.outline == WEDGE
    assert footprint_radius(config) == outline_radius(WEDGE)
    assert RobotConfig.of(config.model_dump(mode="json")) == config

    (tmp_path / "wedge.urdf").write_text(
        "<robot><ros2_control><hardware>"
        f'<param name="footprint">{lists}</param></hardware></ros2_control></robot>'
    )
    assert RobotConfig.load(tmp_path / "wedge.urdf").footprint == WEDGE


def test_outline_without_a_footprint_is_the_body_and_the_wheels_beyond_it() -> None:
    config = RobotConfig()
    assert config.footprint is None
    assert config.outline == make_rectangle(config.body.length, config.body.width)
    wide = config.with_(wheel_separation=0.5, wheelbase=0.6)
    assert wide.outline == make_rectangle(0.61, 0.51)
    assert footprint_radius(wide) == pytest.approx(math.hypot(0.61, 0.51) / 2.0)


@pytest.mark.parametrize(
    ("place", "bearing", "reach"),
    [
        ((0.0, 0.0), 0.0, 0.2),
        ((-0.1, 0.05), math.pi / 2.0, 0.05),
        ((0.0, 0.0), math.atan2(0.1, 0.2), math.hypot(0.2, 0.1)),
        ((0.5, 0.0), 0.0, 0.0),  # it looks away from the robot
        ((0.0, 0.5), -math.pi / 2.0, 0.6),  # the far side counts
    ],
)
def test_outline_reach(place: tuple[float, float], bearing: float, reach: float) -> None:
    outline = make_rectangle(0.4, 0.2)
    assert outline_reach(outline, place, bearing) == pytest.approx(reach)


def test_border_distance_is_that_to_the_nearest_point_of_a_side() -> None:
    outline = ((0.3, -0.2), (0.4, 0.1), (-0.1, 0.3), (-0.3, -0.3))
    corners = np.array(outline)
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    border = corners + shares * (np.roll(corners, -1, axis=0) - corners)
    for place in ((0.0, 0.0), (0.1, 0.15), (-0.2, -0.1), (0.5, 0.5), (-0.6, 0.0)):
        expected = np.linalg.norm(border - place, axis=2).min()
        assert border_distance(outline, *place) == pytest.approx(expected, abs=1e-4)

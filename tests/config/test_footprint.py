"""Outlines of robots: what is refused, and the pieces that they fall into."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.config.footprint import (
    Outline,
    contains_point,
    convex_pieces,
    make_rectangle,
    outline_radius,
    outline_reach,
    validate_outline,
)
from acsar_gym.errors import ConfigError
from acsar_gym.worlds.search import footprint_radius

WEDGE = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
NOTCHED = ((0.3, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.3, -0.2), (0.05, 0.0))
STAR = tuple(
    (r * math.cos(a), r * math.sin(a))
    for r, a in zip([0.3, 0.1] * 5, np.arange(10) * math.pi / 5.0, strict=True)
)
SHAPES = {"box": make_rectangle(0.4, 0.2), "wedge": WEDGE, "notched": NOTCHED, "star": STAR}


def area(outline: Outline) -> float:
    x, y = np.array(outline).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0


@pytest.mark.parametrize("name", SHAPES)
def test_pieces_are_convex_and_cover_it_once(name: str) -> None:
    outline = validate_outline(SHAPES[name])
    pieces = convex_pieces(outline)
    assert (len(pieces) == 1) == (name in ("box", "wedge"))
    assert sum(map(area, pieces)) == pytest.approx(area(outline))
    for piece in pieces:
        edges = np.roll(np.array(piece), -1, axis=0) - piece
        after = np.roll(edges, -1, axis=0)
        assert (edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0] > 0.0).all()
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(-0.35, 0.35, (300, 2)).tolist():
        assert contains_point(outline, x, y) == any(contains_point(piece, x, y) for piece in pieces)


BAD: dict[str, Any] = {
    "two corners": ((1, 1), (-1, -1)),
    "a bow": ((1, 1), (-1, -1), (-1, 1), (1, -1)),
    "a side that comes back": ((1, 1), (-1, 1), (-3, 1), (-1, 1), (-1, -1), (1, -1)),
    "a corner on a side": ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 3), (1, 1.5)),
    "the origin outside": ((2, 1), (1, 1), (1, -1), (2, -1)),
    "no number": ((1, 1), (-1, 1), (0, math.nan)),
    "too far": ((1, 1), (-1, 1), (0, -101)),
    "text": "[[1, 1], [-1, 1]",
}


@pytest.mark.parametrize("name", BAD)
def test_bad_outlines_are_one_line_that_names_the_field(name: str) -> None:
    with pytest.raises(ConfigError, match=r"^footprint") as caught:
        RobotConfig(footprint=BAD[name])
    assert "\n" not in str(caught.value)


def test_a_robots_file_has_it(tmp_path: Path) -> None:
    lists = json.dumps(WEDGE)
    (tmp_path / "wedge.yaml").write_text(f"footprint: {lists}\nwheelbase: 0.1\n")
    config = RobotConfig.load(tmp_path / "wedge.yaml")
    assert config.footprint == config.outline == WEDGE
    assert footprint_radius(config) == outline_radius(WEDGE)
    assert RobotConfig.of(config.model_dump(mode="json")) == config
    assert config.with_(wheelbase=0.2).footprint == WEDGE
    (tmp_path / "wedge.urdf").write_text(
        "<robot><ros2_control><hardware>"
        f'<param name="footprint">{lists}</param></hardware></ros2_control></robot>'
    )
    assert RobotConfig.load(tmp_path / "wedge.urdf").footprint == WEDGE
    (tmp_path / "wedge.yaml").write_text("footprint: [[0.1, 0.0], [0.2, 0.1]]\n")
    with pytest.raises(ConfigError, match=r"wedge\.yaml: footprint = .*: must be 3 to 100 corners"):
        RobotConfig.load(tmp_path / "wedge.yaml")


def test_without_one_it_is_the_body_and_the_wheels_beyond_it() -> None:
    config = RobotConfig()
    assert config.footprint is None
    assert config.outline == make_rectangle(config.body.length, config.body.width)
    wide = config.with_(wheel_separation=0.5, wheelbase=0.6)
    assert wide.outline == make_rectangle(0.61, 0.51)
    assert footprint_radius(wide) == pytest.approx(math.hypot(0.61, 0.51) / 2.0)


def test_reach_is_the_distance_to_the_edge_along_a_bearing() -> None:
    outline = make_rectangle(0.4, 0.2)
    assert outline_reach(outline, (0.0, 0.0), 0.0) == pytest.approx(0.2)
    assert outline_reach(outline, (-0.1, 0.0), 0.0) == pytest.approx(0.3)
    assert outline_reach(outline, (-0.1, 0.05), math.pi / 2.0) == pytest.approx(0.05)
    assert outline_reach(outline, (0.0, 0.0), math.atan2(0.1, 0.2)) == pytest.approx(
        math.hypot(0.2, 0.1)
    )
    assert outline_reach(outline, (0.5, 0.0), 0.0) == 0.0, "it looks away from the robot"
    assert outline_reach(outline, (0.0, 0.5), -math.pi / 2.0) == pytest.approx(0.6), (
        "the far side counts"
    )

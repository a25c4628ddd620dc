"""The README's moving picture, and the script that draws it."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.render.top_view import OBSTACLE_COLOUR
from acsar_gym.resources import ASSETS
from acsar_gym.worlds import Region, World

Pillow = pytest.importorskip("PIL.Image")
PICTURE = ASSETS / "pictures" / "three_views.gif"
WORLD = World(np.array([[2.0, 0.0, 0.3]]), start=Region(0.0, 0.0), goal=Region(3.0, 2.0))


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("three_views", PICTURE.with_suffix(".py"))
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["three_views"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["three_views"]


def track(script: ModuleType, steps: int) -> Any:
    """Straight ahead, past a LiDAR's echo at (2, 0)."""
    poses = np.zeros((steps + 1, 3))
    poses[:, 0] = 0.05 * np.arange(steps + 1)
    robot = RobotConfig.of(None)
    scans = np.full((steps + 1, robot.lidar.rays), robot.lidar.max_range)
    scans[:, robot.lidar.rays // 2] = 1.0
    return script.DrawnTrack(poses, poses, scans, (3.0, 2.0), 0.15, 0.1, robot, WORLD)


def test_the_readme_shows_it_and_it_is_small() -> None:
    assert "(assets/pictures/three_views.gif)" in (ASSETS.parent / "README.md").read_text("utf-8")
    assert PICTURE.stat().st_size < 1_000_000
    with Pillow.open(PICTURE) as film:
        assert film.n_frames > 50
        assert film.info["loop"] == 0, "for ever"
        assert 66 <= film.info["duration"] <= 100, "10 to 15 pictures a second"


def test_the_map_is_what_the_lidar_said(script: ModuleType) -> None:
    angles, ranges = np.array([-math.pi / 2, 0.0, 1.0]), np.array([1.0, 2.0, 10.0])
    seen = script.mapped(np.zeros((0, 2)), np.array([1.0, 1.0, math.pi / 2]), angles, ranges)
    assert seen.tolist() == [[1.0, 3.0], [2.0, 1.0]], "echoes in the world; the far one isn't kept"
    assert script.mapped(seen, np.array([1.0, 1.0, math.pi / 2]), angles, ranges).shape == (2, 2)
    driven = track(script, 1)
    (known,), (told,) = (list(script.from_above(driven, 1, known=k)) for k in (True, False))
    assert known.shape == told.shape == (script.SIDE, script.SIDE, 3)
    dark = [(picture == OBSTACLE_COLOUR).all(axis=2).sum() for picture in (known, told)]
    assert dark[0] > 10 * dark[1] > 0, "a disc; a point"

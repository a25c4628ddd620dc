"""Contact sheets of worlds, and checks whether a robot can cross them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from serial_tools import cli
from top_view_tools import COURT

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.render.top_view import GOAL_COLOUR, OBSTACLE_COLOUR, START_COLOUR
from acsar_gym.tools import atlas
from acsar_gym.tools.tile import TITLE_HEIGHT, draw_tile
from acsar_gym.worlds import Region, World, files, generators
from acsar_gym.worlds.search import footprint_radius

BARN = Path(__file__).parents[3] / "shared" / "barn"


def test_draw_worlds_shows_every_world(tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    _, worlds = atlas.collect_worlds("rooms:5", None, None, 1)
    atlas.draw_worlds(worlds, out)
    side = atlas.TILE_SIZE
    with Image.open(out) as picture:
        assert picture.size == (atlas.COLUMNS * side, 2 * side)
        pixels = np.asarray(picture.convert("L"))
    tiles = pixels.reshape(2, side, atlas.COLUMNS, side).swapaxes(1, 2).reshape(-1, side, side)
    dark = (tiles < 90).sum(axis=(1, 2))
    assert dark[:5].min() > 500  # walls
    assert dark[5:].max() < 50


def test_collect_worlds_makes_the_first_of_a_generator_and_not_too_many() -> None:
    world_set, worlds = atlas.collect_worlds("rooms", None, None, count=2)
    assert [world.name for world in worlds] == ["rooms 0", "rooms 1"]
    assert len(world_set.numbers) == 2
    with pytest.raises(ConfigError, match="rooms:3: 3 worlds are too many, at most 2 here"):
        atlas.collect_worlds("rooms:3", None, None, count=1, most=2)


def test_check_worlds_measures_paths() -> None:
    _, worlds = atlas.collect_worlds("barn:1", None, None, 1)
    blocked = World(np.array([[3.0, 0.0, 0.5]]), goal=Region(3.0, 0.0))
    clear, fault = atlas.check_worlds([worlds[0], blocked], None)
    assert clear["name"] == "barn 0"
    assert 10.0 <= clear["shortest"] <= clear["path"] + 1e-6
    assert clear["fault"] == ""
    assert fault["shortest"] is None
    assert fault["fault"]
    assert atlas.findings_table("barn", [clear, fault]).row_count == 2


def test_worlds_convert_writes_a_world_that_loads_equal(tmp_path: Path) -> None:
    radius = footprint_radius(RobotConfig.preset("acsar"))
    expected = generators.generate_world("clutter", 7, None, radius)
    done = cli("worlds", "convert", "clutter:7-7", tmp_path / "world.json")
    assert (done.returncode, done.stderr) == (0, "")
    world = files.load_world(tmp_path / "world.json")
    assert (world.segments == expected.segments).all()
    assert world.length == expected.length


@pytest.mark.skipif(not BARN.is_dir(), reason="no published worlds here")
def test_check_worlds_of_the_published_barn() -> None:
    _, worlds = atlas.collect_worlds(str(BARN), None, None, 1)
    findings = atlas.check_worlds(worlds, None)
    assert [finding["obstacles"] for finding in findings] == [237, 208, 209, 236, 277]
    assert all(finding["fault"] == "" for finding in findings)
    assert all(finding["shortest"] <= finding["path"] for finding in findings)


def test_draw_tile() -> None:
    turned = replace(COURT, start=Region(0.0, 0.0, 0.0, math.pi / 2))
    bare = World(goal=Region(3.0, 1.0), path=np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]]))
    tiles = [draw_tile(world, 200) for world in (COURT, turned, bare)]

    title = TITLE_HEIGHT
    inks = [(tile[4 : title - 4, 8:100].sum(axis=2) < 450).sum() for tile in tiles]
    assert inks[0] == inks[1] > 20
    assert inks[2] == 0, "it has no name"
    assert all((tile == START_COLOUR).all(axis=2).any() for tile in tiles)
    blue = [np.argwhere((tile == START_COLOUR).all(axis=2)) for tile in tiles]
    assert np.ptp(blue[0], axis=0).argmax() == 1, "x is to the right"
    assert np.ptp(blue[1], axis=0).argmax() == 0, "y is up"
    assert blue[1].mean(axis=0)[0] < blue[0].mean(axis=0)[0] - 2, "it points up"

    walls = np.argwhere((tiles[0] == OBSTACLE_COLOUR).all(axis=2))[:, 0]
    assert walls.min() > title
    assert abs((walls.min() - title) - (199 - walls.max())) < 3, "it is centred below the title"
    goal = np.argwhere((tiles[2] == GOAL_COLOUR).all(axis=2)).mean(axis=0)
    start = blue[2].mean(axis=0)
    assert goal[0] < start[0], "the goal is above"
    assert goal[1] > start[1]

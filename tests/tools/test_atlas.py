"""Contact sheets of worlds, and checks whether a robot can cross them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from serial_tools import cli

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.render.top_view import FLOOR_COLOUR, GOAL_COLOUR, MOVER_COLOUR
from acsar_gym.tools import atlas
from acsar_gym.worlds import Region, World, files, generators
from acsar_gym.worlds.search import footprint_radius

BARN = Path(__file__).parents[3] / "shared" / "barn"


def test_draw_worlds_shows_every_world(tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    _, worlds = atlas.collect_worlds("crowd:5", None, None, 1)
    atlas.draw_worlds(worlds, out)

    side = atlas.TILE_SIZE
    with Image.open(out) as picture:
        assert picture.size == (atlas.COLUMNS * side, 2 * side)
        pixels = np.asarray(picture.convert("RGB"))
    tiles = (
        pixels.reshape(2, side, atlas.COLUMNS, side, 3).swapaxes(1, 2).reshape(-1, side, side, 3)
    )
    assert len({tile.tobytes() for tile in tiles}) == len(worlds) + 1, "the rest is empty"
    for colour in (GOAL_COLOUR, MOVER_COLOUR):
        assert all((tile == colour).all(axis=2).any() for tile in tiles[:5])
    assert (tiles[5:] == FLOOR_COLOUR).all()
    title = [(tile[8:32, 8:100].sum(axis=2) < 450).sum() for tile in tiles]
    assert min(title[:5]) > 20


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

"""Contact sheets of worlds, and acsar-gym worlds show|check|convert as a user calls it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from serial_tools import cli
from top_view_tools import COURT

from acsar_gym import RobotConfig
from acsar_gym.render.top_view import (
    GOAL_COLOUR,
    OBSTACLE_COLOUR,
    START_COLOUR,
)
from acsar_gym.tools import atlas
from acsar_gym.tools.tile import TITLE_HEIGHT, draw_tile
from acsar_gym.worlds import Region, World, files, generators
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.search import footprint_radius

BARN = Path(__file__).parents[3] / "shared" / "barn"


def test_a_sheet_shows_every_world(tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    done = cli("worlds", "show", "rooms:3", "--columns", "2", "--size", "200", "--out", out)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == f"drawn: {out}"
    with Image.open(out) as picture:
        assert picture.size == (400, 400)
        tiles = np.asarray(picture.convert("L"))
    dark = [(tiles[y : y + 200, x : x + 200] < 90).sum() for y in (0, 200) for x in (0, 200)]
    assert min(dark[:3]) > 500  # walls
    assert dark[3] < 50


def test_what_moves_is_told(tmp_path: Path) -> None:
    done = cli("worlds", "show", "crowd_reacting:2", "--out", tmp_path / "crowd.png")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("movers: ")
    movers = walk([[0, 1], [2, 1]], 0.5), walk([[0, 2], [2, 2]], 1.5)
    seeing, blind = (replace(movers[0], reacts=True, sees_robot=sees) for sees in (True, False))
    assert atlas.describe_movers([World()]) == ""
    assert atlas.describe_movers([World(movers=movers)]) == (
        "movers: 2 in a world, top speeds 0.50 to 1.50 m/s; none reacts"
    )
    assert atlas.describe_movers([World(movers=(seeing, blind)), World()]) == (
        "movers: 0 to 2 in a world, top speeds 0.50 to 0.50 m/s; 2 of 2 react, 1 of these don't "
        "see the robot"
    )


def test_a_check_says_what_a_world_is_like(tmp_path: Path) -> None:
    out = tmp_path / "check.json"
    done = cli("worlds", "check", "barn:2", "--json", out)
    assert (done.returncode, done.stderr) == (0, "")
    assert "barn 0" in done.stdout
    assert "worlds: barn 0 to 1 (test split)" in done.stdout
    told = json.loads(out.read_text())
    assert (told["source"], told["split"]) == ("barn 0 to 1 (test split)", "test")
    one, _ = told["worlds"]
    assert 10.0 <= one["shortest"] <= one["path"] + 1e-6
    assert one["fault"] == ""


def test_a_world_becomes_json_and_back(tmp_path: Path) -> None:
    radius = footprint_radius(RobotConfig.preset("acsar"))
    expected = generators.generate_world("clutter", 7, None, radius)
    for name in ("w.json", "w.yaml"):
        done = cli("worlds", "convert", "clutter:7-7", tmp_path / name)
        assert (done.returncode, done.stderr) == (0, "")
        world = files.load_world(tmp_path / name)
        assert (world.segments == expected.segments).all()
        assert world.length == expected.length


@pytest.mark.skipif(not BARN.is_dir(), reason="no published worlds here")
def test_the_published_worlds_can_be_crossed_and_drawn(tmp_path: Path) -> None:
    _, worlds = atlas.collect_worlds(str(BARN), None, None, 1)
    findings = atlas.check_worlds(worlds, None)
    assert [finding["obstacles"] for finding in findings] == [237, 208, 209, 236, 277]
    assert all(finding["fault"] == "" for finding in findings)
    assert all(finding["shortest"] <= finding["path"] for finding in findings)
    atlas.draw_worlds(worlds, 5, 200, tmp_path / "published.png")
    with Image.open(tmp_path / "published.png") as picture:
        assert picture.size == (1000, 200)


def test_a_tile_is_a_map_with_its_name(tmp_path: Path) -> None:
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

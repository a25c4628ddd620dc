"""Names of the scenes of simulated robots in ROS."""

from __future__ import annotations

import math

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import LinkError, WorldError
from acsar_gym.ros.scenes import find_scene, name_world
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.generators import generate_world

ROBOT = RobotConfig.preset("acsar")


@pytest.mark.parametrize("name", ["clutter:7", "barn:3"])
def test_find_scene_by_its_name(name: str) -> None:
    world = find_scene(name, (), ROBOT).world
    assert world is not None
    assert world.name == name.replace(":", " ")
    assert name_world(world, ROBOT) == name


def test_find_scene_start_replaces_that_of_the_world() -> None:
    assert find_scene("clutter:7", [1.0, 2.0, 0.5], ROBOT).start == (1.0, 2.0, 0.5)


def test_find_scene_without_a_name_is_an_open_floor() -> None:
    assert find_scene("", (), ROBOT) == Scene()
    assert find_scene("", (1.0, 0.0, 0.5), ROBOT) == Scene((1.0, 0.0, 0.5))
    assert name_world(None, ROBOT) == ""


@pytest.mark.parametrize(
    ("name", "start"),
    [("nosuch:7", ()), ("", (1.0, 2.0)), ("clutter:7", (1.0, 2.0, math.nan))],
)
def test_find_scene_that_does_not_exist_is_one_line(name: str, start: tuple[float, ...]) -> None:
    with pytest.raises(WorldError) as refused:
        find_scene(name, start, ROBOT)
    assert "\n" not in str(refused.value)


def test_name_world_that_has_no_name_is_refused() -> None:
    hard = generate_world("clutter", 7, 0.9, 0.25)
    for world in (World(name="hall"), hard):
        with pytest.raises(LinkError, match="takes generated worlds only"):
            name_world(world, ROBOT)

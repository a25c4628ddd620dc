"""Plain Gazebo worlds: what is read, what is left out, and files that are refused in one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, generators, sdf
from acsar_gym.worlds.files import Placement
from acsar_gym.worlds.world import Region

CYLINDER = "<cylinder><radius>0.1</radius><length>1</length></cylinder>"
BOX = "<box><size>2 1 0.4</size></box>"
PLANE = "<plane><normal>0 0 1</normal><size>9 9</size></plane>"
QUARTER = math.pi / 2.0
CASES = Path(__file__).parents[2].parent / "shared" / "cases"


def model(shape: str, at: str = "", inside: str = "", body: str = "", link: str = "") -> str:
    """A model `m` at a pose, with a body."""
    return (
        f"<model name='m'><pose>{at}</pose>{inside}<link name='l'>{link}"
        f"<collision name='c'>{body}<geometry>{shape}</geometry></collision></link></model>"
    )


def sphere(radius: float, at: str = "") -> str:
    return model(f"<sphere><radius>{radius}</radius></sphere>", at)


def sdf_of(*parts: str) -> bytes:
    return f"<sdf version='1.6'><world name='w'>{''.join(parts)}</world></sdf>".encode()


STATE = (
    "<state><model name='m'><pose frame=''>7 8 0 0 0 0</pose><scale>1 1 1</scale></model></state>"
)
TURNED = model(
    CYLINDER,
    f"1 2 0 0 0 {QUARTER}",
    link=f"<pose>3 0 0 0 0 {QUARTER}</pose>",
    body="<pose frame=''>1 0 0 0 0 0</pose>",
)
LIGHT = "<light name='sun'><pose>0 0 10 0.3 0 0</pose></light><gui/><physics name='p'/>"
SYSTEM = "<plugin name='p' filename='gz-sim-physics-system'/>"
DEFAULT = "<plugin name='__default__' filename='__default__'/>"
INSIDES = "<visual name='v'><geometry/></visual><sensor name='s'><plugin/></sensor>"


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (TURNED, [0.0, 5.0, 0.1]),  # poses of model, link and collision are composed
        (model(CYLINDER, "1 2 0 0 0 0") + STATE, [7.0, 8.0, 0.1]),
        (sphere(0.2, "0 0 0.1 1 1 0"), [0.0, 0.0, 0.2]),  # at its widest
        (sphere(1.0, "0 0 1.3 1 1 0"), [0.0, 0.0, 0.6]),  # what lies below 0.5 m
        (model(CYLINDER, f"0 0 0 {math.pi} 0.005 0"), [0.0, 0.0, 0.1]),  # upside down
        (model(CYLINDER, link=INSIDES) + LIGHT + SYSTEM + DEFAULT, [0.0, 0.0, 0.1]),
        (model(CYLINDER, inside=DEFAULT) + model("<empty/>") + model(PLANE), [0.0, 0.0, 0.1]),
        (model(CYLINDER) + model(BOX, "0 0 -0.2 0 0 0"), [0.0, 0.0, 0.1]),  # a floor
    ],
)
def test_read_obstacles_places_bodies_and_leaves_out_the_rest(
    part: str, expected: list[float], recwarn: pytest.WarningsRecorder
) -> None:
    circles, segments = sdf.read_obstacles(sdf_of(part))
    np.testing.assert_allclose(circles, [expected], atol=1e-12)
    assert not len(segments)
    assert not recwarn


def test_read_obstacles_gives_a_box_four_sides() -> None:
    corners = [[0.5, 3], [0.5, 1], [1.5, 1], [1.5, 3]]
    expected = [[*corner, *corners[k - 3]] for k, corner in enumerate(corners)]
    _, sides = sdf.read_obstacles(sdf_of(model(BOX, f"1 2 0 0 0 {QUARTER}")))
    np.testing.assert_allclose(sides, expected, atol=1e-12)


@pytest.mark.parametrize(("height", "count"), [(sdf.LIDAR_HEIGHT, 0), (0.7, 1)])
def test_read_obstacles_at_the_height_of_the_lidar(height: float, count: int) -> None:
    lamp = sdf_of(model(CYLINDER, "0 0 1.1 0 0 0"))
    assert len(sdf.read_obstacles(lamp, height)[0]) == count


def test_read_obstacles_ignores_comments_before_the_declaration() -> None:
    data = b"<!-- a hall -->\n<?xml version='1.0'?>" + sdf_of(model(CYLINDER))
    assert sdf.read_obstacles(data)[0].tolist() == [[0.0, 0.0, 0.1]]


PLAIN = "only upright cylinders, boxes and spheres with plain poses are read"
FRAME = "<pose relative_to='f'>0 0 0 0 0 0</pose>"
ACTOR = "<actor name='guest'/>"
INCLUDES = f"contains include 'model://sun', actor 'guest': {PLAIN}"
WALKING = "<plugin name='p' filename='walk'/>"
ENTITIES = b"<!DOCTYPE sdf [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><sdf>&e;</sdf>"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (sdf_of(f"<include><uri>model://sun</uri></include>{ACTOR}"), INCLUDES),
        (sdf_of(model(CYLINDER, inside=WALKING)), "contains model/plugin 'p'"),
        (sdf_of(model("<capsule/>")), f"model 'm': has a capsule: {PLAIN}"),
        (sdf_of(model(BOX, "0 0 0 1 0 0")), "model 'm': has a tilted box"),
        (sdf_of(model(CYLINDER, body=FRAME)), "model 'm': a pose has {'relative_to': 'f'}"),
        (sdf_of(sphere(0.2, "nan 0 0 0 0 0")), "model 'm': pose must be 6 numbers, -10000 to"),
        (ENTITIES, "not XML"),
        (b"<a>" * (sdf.MAX_TAGS + 1), "holds too many XML elements"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_load_world_refuses_anything_else_by_name(
    data: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "bad.world"
    path.write_bytes(data)
    with pytest.raises(WorldError) as caught:
        files.load_world(path, Placement(start=(0.0, 0.0, 0.0), goal=(3.0, 0.0)))
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not CASES.is_dir(), reason="the cases aren't here")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fuel_includes.sdf", "contains include '"),
        ("moving_by_plugin.world", "contains include 'model://ground_plane', actor 'person'"),
    ],
)
def test_load_world_refuses_worlds_of_others(name: str, message: str) -> None:
    with pytest.raises(WorldError) as caught:
        files.load_world(CASES / name)
    assert str(caught.value).startswith(f"{CASES / name}: {message}")
    assert "make a ROS map of the world" in str(caught.value)


CORRIDOR = [
    model(CYLINDER.replace("0.1", str(radius)), f"{x} {y} 0 0 0 0")
    for x, y, radius in generators.place_cylinders(np.zeros((0, 0), np.bool_)).tolist()
]
"""The walls that all of BARN's worlds have."""


def world_with_path(folder: Path, cells: object) -> Path:
    if isinstance(cells, bytes):
        (folder / "path_3.npy").write_bytes(cells)
    else:
        np.save(folder / "path_3.npy", np.array(cells))
    path = folder / "world_3.world"
    path.write_bytes(sdf_of(*CORRIDOR))
    return path


def test_load_world_gives_only_barns_own_worlds_its_start_goal_and_path(tmp_path: Path) -> None:
    path = world_with_path(tmp_path, [[0, 0], [10, 20]])
    world = files.load_world(path)
    assert (world.start, world.goal) == (generators.BARN_START, generators.BARN_GOAL)
    expected = [[-2.0, 3.0], [-4.575, 5.075], [-3.075, 8.075], [-2.0, 13.0]]
    np.testing.assert_allclose(np.array(world.path), expected)
    world = files.load_world(path, Placement(goal=(0.0, 12.0)))
    assert (world.start, world.goal) == (generators.BARN_START, Region(0.0, 12.0))
    assert world.path is None, "it leads elsewhere"

    path.write_bytes(sdf_of(*CORRIDOR[1:]))
    with pytest.raises(
        WorldError, match=r"has no start and no goal: run .*OUT.yaml --start X,Y,THETA --goal"
    ):
        files.load_world(path)
    with pytest.raises(WorldError, match=r"obstacles are at x -4.50 to .*, y 0.00 to 5.10\)"):
        files.load_world(path, Placement(goal="-1,3.5"))
    world = files.load_world(path, Placement(start=(1.0, 2.0, 0.5), goal="-1,3.5"))
    assert (world.start, world.goal) == (Region(1.0, 2.0, 0.0, 0.5), Region(-1.0, 3.5))


@pytest.mark.parametrize(
    "cells",
    [
        *([[1, 2, 3]], [[1], [2]], [1, 2], [["a", "b"]], [[math.nan, 1.0]], b"", b"\x80\x04K\x01."),
        b"\x93NUMPY\x01\x00\x80\x00%-127s\n"
        % b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000, 2), }",
    ],
    ids=lambda cells: str(cells)[:20],
)
def test_load_world_refuses_broken_or_hostile_cells(cells: object, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"world_3\.world: path"):
        files.load_world(world_with_path(tmp_path, cells))

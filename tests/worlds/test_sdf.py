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
SPHERE = "<sphere><radius>0.2</radius></sphere>"
BOX = "<box><size>2 1 0.4</size></box>"
PLANE = "<plane><normal>0 0 1</normal><size>9 9</size></plane>"
CAPSULE = "<capsule><radius>0.1</radius><length>1</length></capsule>"
QUARTER = math.pi / 2.0
ENDS = Placement(start=(0.0, 0.0, 0.0), goal=(3.0, 0.0))
CASES = Path(__file__).parents[2].parent / "shared" / "cases"


def model(shape: str, at: str = "", inside: str = "", body: str = "", link: str = "") -> str:
    """A model `m` at a pose, with a body."""
    return (
        f"<model name='m'><pose>{at}</pose>{inside}<link name='l'>{link}"
        f"<collision name='c'>{body}<geometry>{shape}</geometry></collision></link></model>"
    )


def sdf_of(*parts: str) -> bytes:
    return f"<sdf version='1.6'><world name='w'>{''.join(parts)}</world></sdf>".encode()


def obstacles(*parts: str, height: float = sdf.LIDAR_HEIGHT) -> list[list[float]]:
    """Circles and segments."""
    circles, segments = sdf.read_obstacles(sdf_of(*parts), height)
    return [*circles.tolist(), *segments.tolist()]


def state(at: str, scale: str) -> str:
    inside = f"<pose frame=''>{at}</pose><scale>{scale}</scale>"
    return f"<state world_name='w'><model name='m'>{inside}</model></state>"


def ball(radius: float, height: float) -> str:
    return model(SPHERE.replace("0.2", str(radius)), f"0 0 {height} 1 1 0")


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (  # poses of model, link and collision are composed
            [
                model(
                    CYLINDER,
                    f"1 2 0 0 0 {QUARTER}",
                    link=f"<pose>3 0 0 0 0 {QUARTER}</pose>",
                    body="<pose frame=''>1 0 0 0 0 0</pose>",
                )
            ],
            [0.0, 5.0, 0.1],
        ),
        ([model(CYLINDER, "1 2 0 0 0 0")], [1.0, 2.0, 0.1]),
        (
            [model(CYLINDER, "1 2 0 0 0 0"), state("7 8 0 0 0 0", "1 1 1")],
            [7.0, 8.0, 0.1],
        ),
        ([ball(0.2, 0.1)], [0.0, 0.0, 0.2]),  # at its widest
        ([ball(1.0, 1.3)], [0.0, 0.0, 0.6]),  # what lies below 0.5 m
        ([model(CYLINDER, f"0 0 0 {math.pi} 0.005 0")], [0.0, 0.0, 0.1]),  # upside down
    ],
)
def test_round_bodies_lie_where_their_poses_say(parts: list[str], expected: list[float]) -> None:
    np.testing.assert_allclose(obstacles(*parts), [expected], atol=1e-12)


def test_a_box_has_four_sides() -> None:
    corners = [[0.5, 3], [0.5, 1], [1.5, 1], [1.5, 3]]
    expected = [[*corner, *corners[k - 3]] for k, corner in enumerate(corners)]
    turned = obstacles(model(BOX, f"1 2 0 0 0 {QUARTER}"))
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_a_higher_lidar_sees_higher_bodies() -> None:
    lamp = model(CYLINDER, "0 0 1.1 0 0 0")
    assert obstacles(lamp) == []
    assert obstacles(lamp, height=0.7) == [[0.0, 0.0, 0.1]]


@pytest.mark.parametrize(
    "harmless",
    [
        "<light name='sun'><pose>0 0 10 0.3 0 0</pose></light><gui/><physics name='p'/>",
        "<plugin name='p' filename='gz-sim-physics-system'/>",
        model(PLANE),
        model("<empty/>"),
        model(BOX, "0 0 -0.2 0 0 0"),  # a floor
        "<model name='m'><link name='l'><visual name='v'><geometry/></visual></link></model>",
        "<model name='m'><link name='l'><sensor name='s'><plugin/></sensor></link></model>",
    ],
)
def test_what_is_no_obstacle_is_left_out(harmless: str) -> None:
    assert obstacles(harmless, model(CYLINDER)) == [[0.0, 0.0, 0.1]]


def test_defaults_that_gazebo_saves_are_ignored(recwarn: pytest.WarningsRecorder) -> None:
    default = "<plugin name='__default__' filename='__default__'/>"
    assert obstacles(default, model(CYLINDER, inside=default)) == [[0.0, 0.0, 0.1]]
    assert not recwarn


@pytest.mark.parametrize("preface", ["<!-- a hall -->\n", "\n  ", "<!-- a --> <!-- b -->\n"])
def test_a_comment_before_the_declaration_is_ignored(preface: str) -> None:
    data = f"{preface}<?xml version='1.0'?>".encode() + sdf_of(model(CYLINDER))
    assert sdf.read_obstacles(data)[0].tolist() == [[0.0, 0.0, 0.1]]


PLAIN = "only upright cylinders, boxes and spheres with plain poses are read"


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("<include><uri>model://sun</uri></include>", f"contains include 'model://sun': {PLAIN}"),
        ("<actor name='guest'/><population/>", "contains actor 'guest', population ''"),
        (model(CYLINDER, inside="<plugin name='p' filename='walk'/>"), "contains model/plugin 'p'"),
        ("<model name='o'><model name='i'/></model>", "contains model/model 'i'"),
        (model(CAPSULE), f"model 'm': has a capsule: {PLAIN}"),
        (model(BOX, "0 0 0 1 0 0"), "model 'm': has a tilted box"),
        (model(PLANE, "0 0 0 0 1 0"), "model 'm': has a tilted plane"),
        (
            model(CYLINDER, body="<pose relative_to='f'>0 0 0 0 0 0</pose>"),
            "model 'm': a pose has {'relative_to': 'f'}",
        ),
        (
            model(CYLINDER) + state("0 0 0 0 0 0", "1 2 1"),
            "contains state/model/scale[.!='1 1 1'] ''",
        ),
        (model(SPHERE, "nan 0 0 0 0 0"), "model 'm': pose must be 6 numbers, -10000 to"),
        (model("<sphere/>"), "model 'm': radius must be 1 numbers, 0 to 10000, is ''"),
    ],
)
def test_anything_else_is_refused_by_name(part: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.world"
    path.write_bytes(sdf_of(model(CYLINDER), part))
    with pytest.raises(WorldError) as caught:
        files.load_world(path, ENDS)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not CASES.is_dir(), reason="the cases aren't here")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fuel_includes.sdf", "contains include '"),
        ("moving_by_plugin.world", "contains include 'model://ground_plane', actor 'person'"),
        ("relative_to.sdf", "model 'm': a pose has {'relative_to': 'f'}"),
        ("capsule.sdf", "model 'post': has a capsule"),
    ],
)
def test_worlds_of_others_are_refused(name: str, message: str) -> None:
    with pytest.raises(WorldError) as caught:
        files.load_world(CASES / name)
    assert str(caught.value).startswith(f"{CASES / name}: {message}")
    assert "make a ROS map of the world" in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"<sdf><world>", "not XML"),
        (b"<robot/>", "one <world>"),
        (b"<!DOCTYPE sdf [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><sdf>&e;</sdf>", "Forbidden"),
        (b"<a>" * (sdf.MAX_TAGS + 1), "too many XML elements"),
    ],
    ids=["XML", "robot", "entities", "tags"],
)
def test_bad_files_are_refused(data: bytes, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        sdf.read_obstacles(data)


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


def test_the_path_of_a_barn_world_is_read(tmp_path: Path) -> None:
    world = files.load_world(world_with_path(tmp_path, [[0, 0], [10, 20]]))
    expected = [[-2.0, 3.0], [-4.575, 5.075], [-3.075, 8.075], [-2.0, 13.0]]
    assert world.path is not None
    np.testing.assert_allclose(world.path, expected)


def test_only_barns_own_worlds_have_its_start_and_goal(tmp_path: Path) -> None:
    path = world_with_path(tmp_path, [[0, 0], [10, 20]])
    world = files.load_world(path)
    assert (world.start, world.goal) == (generators.BARN_START, generators.BARN_GOAL)
    world = files.load_world(path, Placement(goal=(0.0, 12.0)))
    assert (world.start, world.goal) == (generators.BARN_START, Region(0.0, 12.0))
    assert world.path is None, "it leads elsewhere"

    path.write_bytes(sdf_of(*CORRIDOR[1:]))
    with pytest.raises(
        WorldError, match=r"has no start and no goal: run .*OUT.yaml --start X,Y,THETA --goal"
    ):
        files.load_world(path)
    with pytest.raises(WorldError, match=r"has no goal: run .*OUT.yaml --goal X,Y' \[m, rad\]"):
        files.load_world(path, Placement(start=(1.0, 2.0)))
    world = files.load_world(path, Placement(start=(1.0, 2.0, 0.5), goal="-1,3.5"))
    assert (world.start, world.goal) == (Region(1.0, 2.0, 0.0, 0.5), Region(-1.0, 3.5))
    assert files.load_world(path, Placement(start="1, 2", goal=[0, 0])).start.theta is None


@pytest.mark.parametrize(
    "cells",
    [
        *([[1, 2, 3]], [["a", "b"]], [[1j, 2]], [[math.nan, 1.0]], [[10**9, 0]], [[0, 0]] * 20_001),
        *(b"", b"PK\x03\x04", b"\x80\x04K\x01."),
        b"\x93NUMPY\x01\x00\x80\x00%-127s\n"
        % b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000, 2), }",
    ],
    ids=lambda cells: str(cells)[:20],
)
def test_broken_or_hostile_cells_are_refused(cells: object, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"world_3\.world: path"):
        files.load_world(world_with_path(tmp_path, cells))

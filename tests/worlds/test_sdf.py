"""Gazebo worlds: frames, included models, what moves or is left out, and files that mean harm."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gazebo_texts import CYLINDER, body, include, model, moving, pose, sdf_of, write_model

from acsar_gym.errors import AcsarWarning, WorldError
from acsar_gym.worlds import files, generators, sdf
from acsar_gym.worlds.files import Placement
from acsar_gym.worlds.world import Region

BILLION_LAUGHS = "<!DOCTYPE sdf [<!ENTITY e0 'ha'>{}]>".format(
    "".join(f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 10))
)
SPHERE = "<sphere><radius>0.2</radius></sphere>"
BOX = "<box><size>2 1 0.4</size></box>"


ENDS = Placement(start=(0.0, 0.0, 0.0), goal=(3.0, 0.0))


def drawn(*models: str) -> tuple[list[list[float]], list[list[float]]]:
    found = sdf.read_obstacles(sdf_of(*models))
    return found.circles.tolist(), found.segments.tolist()


QUARTER = math.pi / 2.0
AHEAD = body(CYLINDER, pose(1, 0, 0, 0, 0, 0))


def relative(frame: str, *numbers: float) -> str:
    return pose(*numbers, attributes=f"relative_to='{frame}'")


FRAME = f"</link><frame name='f'>{pose(0, 1, 0, 0, 0, QUARTER)}</frame><link name='k'>"
ABOVE_FRAME = relative("f", 1, 1, 0, 0, 0, 0)
WITH_JOINT = (
    f"<model name='o'>{pose(2, 0, 0, 0, 0, 0)}"
    f"<joint name='j'><child>i::l</child>{pose(0, 0, 1, 0, 0, QUARTER)}</joint>"
    f"<model name='i'>{pose(0, 3, 0, 0, 0, 0)}<link name='l'/></model>"
    f"<link name='a'>{relative('j', 1, 0, -1, 0, 0, 0)}{body(CYLINDER)}</link></model>"
)
STATE = f"<state world_name='w'><model name='m'>{pose(7, 8, 0, 0, 0, 0)}</model></state>"


@pytest.mark.parametrize(
    ("models", "expected"),
    [
        (  # poses of model, link and collision are composed
            [model(AHEAD, pose(1, 2, 0, 0, 0, QUARTER), link=pose(3, 0, 0, 0, 0, QUARTER))],
            [0.0, 5.0, 0.1],
        ),
        ([model(body(SPHERE), pose(1, 2, 0.1, 0, 0, 0))], [1.0, 2.0, 0.2]),  # at its widest
        ([model(body(CYLINDER), pose(1, 2, 0, 0, 0, 0)), STATE], [7.0, 8.0, 0.1]),
        ([model(body(CYLINDER, ABOVE_FRAME), pose(1, 2, 0, 0, 0, 0), link=FRAME)], [0, 4, 0.1]),
        (  # a model in another one's frame, and in a frame of the world
            [
                f"<frame name='f' attached_to='n'>{pose(0, 1, 0, 0, 0, 0)}</frame>",
                model(body(CYLINDER), relative("f", 1, 0, 0, 0, 0, 0)),
                model("", pose(5, 0, 0, 0, 0, QUARTER), name="n"),
            ],
            [4.0, 1.0, 0.1],
        ),
        (  # a joint's frame is its child's, a name may lead into another model
            [WITH_JOINT],
            [2.0, 4.0, 0.1],
        ),
        ([model(body(SPHERE.replace("0.2", "1")), pose(0, 0, 1.3, 0, 0, 0))], [0, 0, 0.6]),
    ],
)
def test_round_bodies_lie_where_their_poses_say(models: list[str], expected: list[float]) -> None:
    np.testing.assert_allclose(drawn(*models)[0], [expected], atol=1e-12)


@pytest.mark.parametrize(
    "harmless",
    [
        "<include><uri>model://sun</uri></include>",
        *(
            f"<include><uri>https://fuel.{home}.org/1.0/OpenRobotics/models/{name}</uri></include>"
            for home in ("gazebosim", "ignitionrobotics")
            for name in ("Ground Plane", "Sun", "sun/2", "Ground%20Plane/tip")
        ),
        "<light name='sun'><pose>0 0 10 0.3 0 0</pose></light>",
        model(body("<plane><normal>0 0 1</normal><size>9 9</size></plane>")),
        model("<visual name='v'><geometry><mesh><uri>x</uri></mesh></geometry></visual>"),
        model(body(CYLINDER), pose(0, 0, 1.1, 0, 0, 0)),  # hangs above the robot
        model(body(BOX), pose(0, 0, -0.2, 0, 0, 0)),  # a floor
        model("<inertial><pose>0 0 0 1 1 1</pose></inertial>"),
    ],
)
def test_what_is_no_obstacle_is_left_out(harmless: str) -> None:
    assert drawn(harmless) == ([], [])


IN_A_CIRCLE = (
    "</link><frame name='a' attached_to='b'/><frame name='b' attached_to='a'/><link name='k'>"
)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (model(body(SPHERE), pose("nan", 0, 0, 0, 0, 0)), "pose must be 6 finite"),  # type: ignore[arg-type]
        (model(body(SPHERE.replace("0.2", "-1"))), "radius must not be negative"),
        (model(body("<mesh><uri>x.dae</uri></mesh>")), "there is no mesh 'x.dae'"),
        (model(body("<heightmap><uri>x.png</uri></heightmap>")), "a heightmap is uneven ground"),
        (
            model(body("<polyline><height>1</height></polyline>"), pose(0, 0, 0, 1, 0, 0)),
            "a polyline is tilted",
        ),
        (model(body(CYLINDER), pose(0, 0, 0, 0, 0, 0, attributes="relative_to='x'")), "'x'"),
        (
            model(body(CYLINDER, relative("a", *[0] * 6)), link=IN_A_CIRCLE),
            "frames are relative to each other in a circle",
        ),
    ],
)
def test_bad_models_are_refused_by_name(broken: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.world"
    path.write_bytes(sdf_of(model(body(CYLINDER), name="fine"), broken))
    with pytest.raises(WorldError, match=r"bad\.world: model 'm': ") as caught:
        files.load_world(path, ENDS)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not valid XML"),
        (b"<robot/>", "one <world>"),
        (sdf_of("<include><uri>model://house</uri></include>"), "includes 'model://house'"),
        (sdf_of("<model>" * 12 + "</model>" * 12), "nested"),
        (f"{BILLION_LAUGHS}<sdf>&e9;</sdf>".encode(), "entities"),
        (b"<!DOCTYPE sdf [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><sdf>&e;</sdf>", "entities"),
    ],
)
def test_bad_files_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.sdf"
    path.write_bytes(data)
    with pytest.raises(WorldError, match=r"bad\.sdf: ") as caught:
        files.load_world(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


CORRIDOR = [
    model(body(CYLINDER.replace("0.1", str(radius))), pose(x, y, 0, 0, 0, 0), name=f"c{number}")
    for number, (x, y, radius) in enumerate(
        generators.place_cylinders(np.zeros((0, 0), np.bool_)).tolist()
    )
]
"""The walls that all of BARN's worlds have."""


def world_with_path(folder: Path, cells: bytes) -> Path:
    (folder / "path_3.npy").write_bytes(cells)
    path = folder / "world_3.world"
    path.write_bytes(sdf_of(*CORRIDOR))
    return path


def npy(tmp_path: Path, cells: object) -> bytes:
    np.save(tmp_path / "cells.npy", np.array(cells))
    return (tmp_path / "cells.npy").read_bytes()


def test_the_path_beside_a_world_is_read(tmp_path: Path) -> None:
    world = files.load_world(world_with_path(tmp_path, npy(tmp_path, [[0, 0], [10, 20]])))
    expected = [[-2.0, 3.0], [-4.575, 5.075], [-3.075, 8.075], [-2.0, 13.0]]
    assert world.path is not None
    np.testing.assert_allclose(world.path, expected)


def test_only_barns_own_worlds_have_its_start_and_goal(tmp_path: Path) -> None:
    path = world_with_path(tmp_path, npy(tmp_path, [[0, 0], [10, 20]]))
    world = files.load_world(path)
    assert (world.start, world.goal) == (generators.BARN_START, generators.BARN_GOAL)
    world = files.load_world(path, Placement(goal=(0.0, 12.0)))
    assert (world.start, world.goal) == (generators.BARN_START, Region(0.0, 12.0))
    assert world.path is None, "it leads elsewhere"
    for others in (CORRIDOR[1:], [model(body(BOX))], []):
        path.write_bytes(sdf_of(*others))
        with pytest.raises(WorldError, match="has no start and no goal: add --start X,Y,THETA"):
            files.load_world(path)
        with pytest.raises(WorldError, match=r"has no goal: add --goal X,Y \[m, rad\] in"):
            files.load_world(path, Placement(start=(1.0, 2.0)))
    world = files.load_world(path, Placement(start=(1.0, 2.0, 0.5), goal="-1,3.5"))
    assert (world.start, world.goal) == (Region(1.0, 2.0, 0.0, 0.5), Region(-1.0, 3.5))
    assert files.load_world(path, Placement(start="1, 2", goal=[0, 0])).start.theta is None


HEADER = b"\x93NUMPY\x01\x00\x80\x00%-127s\n"


@pytest.mark.parametrize(
    "cells",
    [
        *([1, 2, 3], [[1, 2, 3]], [[math.nan, 1.0]], [["a", "b"]], [[1j, 2]]),
        *([[10**9, 0]], [[-(2**63), 0]], [[0, 0]] * 20_001),
        *(b"", b"PK\x03\x04", b"\x80\x04K\x01."),
        HEADER % b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000, 2), }",
        HEADER % b"{'",
    ],
    ids=lambda cells: str(cells)[:20],
)
def test_wrong_broken_or_hostile_cells_are_refused(cells: object, tmp_path: Path) -> None:
    if isinstance(cells, bytes):
        data, problem = cells, r"path_3\.npy: isn't a sound \.npy file"
    else:
        data, problem = npy(tmp_path, cells), r"world_3\.world: path"
    with pytest.raises(WorldError, match=problem):
        files.load_world(world_with_path(tmp_path, data))


WALKER = "<plugin name='walk' filename='libwalk_back_and_forth.so'/>"
ACTOR = "<actor name='person'><script><trajectory id='0' type='walk'/></script></actor>"


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ([ACTOR], "actor 'person' is left out"),
        (
            [moving(WALKER, "a"), moving(WALKER, "b"), ACTOR],
            (
                "model 'a' (plugin 'libwalk_back_and_forth.so'), model 'b' (plugin "
                "'libwalk_back_and_forth.so') stand where they begin; actor 'person' is left out"
            ),
        ),
        (
            [moving("<plugin filename='gz-sim-velocity-control-system' name='gz::sim::V'/>")],
            "model 'm' (plugin 'gz-sim-velocity-control-system')",
        ),
    ],
    ids=["actor", "several", "new Gazebo"],
)
def test_what_moves_is_named(parts: list[str], said: str, tmp_path: Path) -> None:
    path = tmp_path / "moving.world"
    path.write_bytes(sdf_of(*parts))
    with pytest.warns(AcsarWarning) as caught:
        files.load_world(path, ENDS)
    (warning,) = caught
    start = f"{path}: what moves in Gazebo doesn't move here: {said}"
    assert str(warning.message).startswith(start)
    assert "\n" not in str(warning.message)


@pytest.mark.parametrize(
    "parts",
    [
        [model("<sensor name='s' type='ray'><plugin name='p' filename='libx.so'/></sensor>")],
        *(
            [moving(f"<plugin name='p' filename='{file}'/>")]
            for file in (
                *("libgazebo_ros_camera.so", "libRayPlugin.so", "libgazebo_ros_p3d.so"),
                *("gz-sim-pose-publisher-system", "libgazebo_ros_joint_state_publisher.so"),
            )
        ),
        ["<plugin name='p' filename='libx.so'/>", model("")],
    ],
)
def test_what_only_measures_or_shines_is_no_mover(parts: list[str]) -> None:
    found = sdf.read_obstacles(sdf_of(*parts))
    assert (found.movers, found.standing, found.actors) == ((), (), ())


# Models of other files


def load_included(folder: Path, *parts: str, models: str = "") -> Any:
    path = folder / "hall.world"
    path.write_bytes(sdf_of(*parts))
    placement = Placement(start=(0, 0, 0), goal=(3, 0), models=models)
    return files.load_world(path, placement).circles.round(9).tolist()


MOVED = model(AHEAD, pose(1, 0, 0, 0, 0, QUARTER), name="table")


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ("", [1.0, 1.0, 0.1]),
        (f"<name>t2</name>{pose(5, 5, 0, 0, 0, QUARTER)}<static>true</static>", [5.0, 6.0, 0.1]),
        (f"<name>n</name>{relative('base', 1, 0, 0, 0, 0, 0)}", [2.0, 3.0, 0.1]),
    ],
)
def test_an_include_names_and_places_a_model(
    inside: str, expected: list[float], tmp_path: Path
) -> None:
    write_model(tmp_path / "models", "table", MOVED)
    base = f"<frame name='base'>{pose(2, 2, 0, 0, 0, QUARTER)}</frame>"
    where = load_included(tmp_path, base, include("model://table", inside))
    expected = [2.0, 4.0, 0.1] if "base" in inside else expected
    assert where == [expected]


@pytest.mark.parametrize("way", ["option", "GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "itself"])
def test_models_are_found_where_gazebo_finds_them(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_model(tmp_path / "elsewhere", "table", MOVED)
    (tmp_path / "worlds").mkdir()
    folders = f"{tmp_path / 'none'}:{tmp_path / 'elsewhere'}"
    if way in ("option", "itself"):
        models = folders if way == "option" else str(tmp_path / "elsewhere" / "table")
        where = load_included(tmp_path / "worlds", include("model://table"), models=models)
    else:
        monkeypatch.setenv(way, folders)
        where = load_included(tmp_path / "worlds", include("model://table"))
    assert where == [[1.0, 1.0, 0.1]]


@pytest.mark.parametrize(
    "uri",
    [
        "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Work Table",
        "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Work%20Table/2",
        "model://work_table",
    ],
)
@pytest.mark.parametrize("kept", ["work table/2", "work_table"])
def test_models_of_fuel_are_read_where_they_were_downloaded(
    uri: str, kept: str, tmp_path: Path
) -> None:
    write_model(tmp_path / "fuel", kept, MOVED)
    parts = [include(uri)]
    if uri.startswith("model") and " " in kept:
        parts = [include("model://work table")]
    assert load_included(tmp_path, *parts, models=str(tmp_path / "fuel")) == [[1.0, 1.0, 0.1]]


def test_models_include_models(tmp_path: Path) -> None:
    write_model(tmp_path, "leg", model(body(CYLINDER), pose(0, 1, 0, 0, 0, 0), name="leg"))
    legs = include("model://leg") + include("model://leg", pose(0, 2, 0, 0, 0, 0))
    write_model(tmp_path, "table", f"<model name='table'>{legs}</model>")
    where = load_included(tmp_path, include("model://table", pose(5, 0, 0, 0, 0, 0)))
    assert where == [[5.0, 1.0, 0.1], [5.0, 2.0, 0.1]]
    merged = include("model://leg", attributes="merge='true'")
    on_leg = f"<link name='top'>{relative('l', 1, 0, 0, 0, 0, 0)}{body(CYLINDER)}</link>"
    write_model(tmp_path, "table", f"<model name='table'>{merged}{on_leg}</model>")
    assert load_included(tmp_path, include("model://table")) == [[1.0, 1.0, 0.1], [0.0, 1.0, 0.1]]


def refuse_included(folder: Path, *parts: str) -> str:
    with pytest.raises(WorldError) as caught:
        load_included(folder, *parts)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_missing_models_are_named_together(tmp_path: Path) -> None:
    name = "Construction Barrel of the longest name that anybody has ever given to one"
    fuel = f"https://fuel.gazebosim.org/1.0/OpenRobotics/models/{name}"
    parts = [include("model://table"), include(fuel), include("model://table")]
    assert (
        f"includes 'model://table', {name!r} of Fuel, which no model folder has: name the folder "
        "with --models FOLDER"
    ) in refuse_included(tmp_path, *parts)
    many = refuse_included(tmp_path, *(include(f"model://t{number}") for number in range(9)))
    assert "'model://t4' and 4 others, which" in many


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (f"<model name='m'>{include('model://m')}</model>", "models are nested too deeply"),
        ("<model name='m'><link>", "included .*: not valid XML"),
        ("<!DOCTYPE sdf [<!ENTITY e 'x'>]><model name='m'/>", "not valid XML|entities"),
    ],
)
def test_hostile_models_are_refused(content: str, said: str, tmp_path: Path) -> None:
    write_model(tmp_path, "m", content)
    with pytest.raises(WorldError, match=said):
        load_included(tmp_path, include("model://m"))

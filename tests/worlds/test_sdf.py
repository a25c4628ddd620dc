"""Gazebo worlds: poses, shapes, what is left out, and files that mean harm."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, sdf
from acsar_gym.worlds.world import Region

BARN = Path(__file__).parents[2].parent / "shared" / "barn"
published = pytest.mark.skipif(not BARN.is_dir(), reason="the published worlds aren't here")
PUBLISHED = {1: (237, 12.312), 77: (208, 10.758), 101: (209, 10.029), 201: (236, 13.446)}
PUBLISHED[299] = (277, 10.738)
BILLION_LAUGHS = "<!DOCTYPE sdf [<!ENTITY e0 'ha'>{}]>".format(
    "".join(f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 10))
)
CYLINDER = "<cylinder><radius>0.1</radius><length>1</length></cylinder>"
SPHERE = "<sphere><radius>0.2</radius></sphere>"
BOX = "<box><size>2 1 0.4</size></box>"


def body(shape: str, pose: str = "") -> str:
    return f"<collision name='c'>{pose}<geometry>{shape}</geometry></collision>"


def model(inside: str, pose: str = "", name: str = "m", link: str = "") -> str:
    return f"<model name='{name}'>{pose}<link name='l'>{link}{inside}</link></model>"


def pose(*numbers: float, attributes: str = "") -> str:
    return f"<pose {attributes}>{' '.join(map(str, numbers))}</pose>"


def sdf_of(*models: str) -> bytes:
    return f"<sdf version='1.6'><world name='w'>{''.join(models)}</world></sdf>".encode()


def drawn(*models: str) -> tuple[list[list[float]], list[list[float]]]:
    circles, segments = sdf.read_obstacles(sdf_of(*models))
    return circles.tolist(), segments.tolist()


@published
@pytest.mark.parametrize("number", PUBLISHED)
def test_published_worlds(number: int) -> None:
    world = files.load_world(BARN / f"world_{number}.world")
    cylinders, length = PUBLISHED[number]
    assert (len(world.circles), len(world.segments)) == (cylinders, 0)
    assert set(world.circles[:, 2]) == {0.075}
    assert world.length == pytest.approx(length, abs=0.01)
    assert world.start == Region(-2.0, 3.0, 0.0, math.pi / 2.0)
    assert world.goal == Region(-2.0, 13.0)
    assert world.path is not None
    assert world.path[[0, -1]].tolist() == [[-2.0, 3.0], [-2.0, 13.0]]
    assert world.name == f"world_{number}"


QUARTER = math.pi / 2.0
AHEAD = body(CYLINDER, pose(1, 0, 0, 0, 0, 0))
STATE = f"<state world_name='w'><model name='m'>{pose(7, 8, 0, 0, 0, 0)}</model></state>"


@pytest.mark.parametrize(
    ("models", "expected"),
    [
        (  # poses of model, link and collision are composed
            [model(AHEAD, pose(1, 2, 0, 0, 0, QUARTER), link=pose(3, 0, 0, 0, 0, QUARTER))],
            [0.0, 5.0, 0.1],
        ),
        ([model(AHEAD, pose(0, 0, 0, 0, 0, 90, attributes="degrees='true'"))], [0.0, 1.0, 0.1]),
        ([model(body(SPHERE), pose(1, 2, 0.1, 0, 0, 0))], [1.0, 2.0, 0.2]),  # at its widest
        (
            [f"<model name='outer'>{pose(0, 5, 0, 0, 0, 0)}{model(AHEAD)}</model>"],
            [1.0, 5.0, 0.1],
        ),
        ([model(body(CYLINDER), pose(1, 2, 0, 0, 0, 0)), STATE], [7.0, 8.0, 0.1]),
    ],
    ids=["composed", "degrees", "sphere", "nested", "state"],
)
def test_round_bodies_lie_where_their_poses_say(models: list[str], expected: list[float]) -> None:
    np.testing.assert_allclose(drawn(*models)[0], [expected], atol=1e-12)


def test_boxes_become_four_segments() -> None:
    _, segments = drawn(model(body(BOX), pose(1, 1, 0, 0, 0, math.pi / 2.0)))
    corners = [[0.5, 2.0], [0.5, 0.0], [1.5, 0.0], [1.5, 2.0]]
    expected = [[*corners[i], *corners[(i + 1) % 4]] for i in range(4)]
    np.testing.assert_allclose(segments, expected, atol=1e-12)


def test_a_model_file_has_no_world() -> None:
    circles, _ = sdf.read_obstacles(f"<sdf>{model(body(CYLINDER))}</sdf>".encode())
    assert circles.tolist() == [[0.0, 0.0, 0.1]]


@pytest.mark.parametrize(
    "harmless",
    [
        "<include><uri>model://sun</uri></include>",
        "<include><uri>model://ground_plane/</uri></include>",
        "<light name='sun'><pose>0 0 10 0.3 0 0</pose></light>",
        model(body("<plane><normal>0 0 1</normal><size>9 9</size></plane>")),
        model(body("<empty/>")),
        model("<visual name='v'><geometry><mesh><uri>x</uri></mesh></geometry></visual>"),
        model(body(CYLINDER), pose(0, 0, 1.1, 0, 0, 0)),  # hangs above the robot
        model(body(BOX), pose(0, 0, -0.2, 0, 0, 0)),  # a floor
        model("<inertial><pose>0 0 0 1 1 1</pose></inertial>"),
    ],
)
def test_what_is_no_obstacle_is_left_out(harmless: str) -> None:
    assert drawn(harmless) == ([], [])


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (model(body(CYLINDER), pose(0, 0, 0, 0.1, 0, 0)), "tilted"),
        (model(body(SPHERE), pose("nan", 0, 0, 0, 0, 0)), "pose must be 6 finite"),  # type: ignore[arg-type]
        (model(body(SPHERE), pose(1e9, 2, 3, 4, 5, 6)), "at most 10000"),
        (model(body(SPHERE.replace("0.2", "-1"))), "radius must not be negative"),
        (model(body(SPHERE.replace("0.2", "wide"))), "is 'wide'"),
        (model(body("<sphere/>")), "its sphere has no <radius>"),
        (model(body("<mesh><uri>x.dae</uri></mesh>")), "a mesh can't be read"),
        (model(body("<plane><normal>1 0 0</normal></plane>")), "a plane must be level"),
        (model(body(CYLINDER), pose(0, 0, 0, 0, 0, 0, attributes="relative_to='x'")), "'x'"),
        (
            model(body(CYLINDER), pose(*[0] * 7, attributes="rotation_format='quat_xyzw'")),
            "roll, pitch and yaw",
        ),
        (model(body(CYLINDER)).replace("'m'", "'m' placement_frame='f'"), "placement_frame"),
    ],
)
def test_bad_models_are_refused_by_name(broken: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.world"
    path.write_bytes(sdf_of(model(body(CYLINDER), name="fine"), broken))
    with pytest.raises(WorldError, match=r"bad\.world: model 'm': ") as caught:
        files.load_world(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not valid XML"),
        (b"<?xml version='1.0' encoding='klingon'?><sdf/>", "not valid XML"),
        (b"<robot/>", "one <world>"),
        (sdf_of("<include><uri>model://house</uri></include>"), "includes 'model://house'"),
        (sdf_of("<population><model/></population>"), "population"),
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


@pytest.mark.parametrize(
    ("piece", "count"),
    [(model(body(SPHERE)), 500_000), ("<a/>", 15_000_000), ("<model>", 9_000_000)],
    ids=["bodies", "elements", "depth"],
)
def test_a_million_bodies_are_refused_at_once(piece: str, count: int) -> None:
    data = b"<sdf><world>" + piece.encode() * count
    with pytest.raises(WorldError, match="too many"):
        sdf.read_obstacles(data)


def world_with_path(folder: Path, cells: bytes) -> Path:
    (folder / "path_3.npy").write_bytes(cells)
    path = folder / "world_3.world"
    path.write_bytes(sdf_of(model(body(CYLINDER))))
    return path


def npy(tmp_path: Path, cells: object) -> bytes:
    np.save(tmp_path / "cells.npy", np.array(cells))
    return (tmp_path / "cells.npy").read_bytes()


def test_the_path_beside_a_world_is_read(tmp_path: Path) -> None:
    world = files.load_world(world_with_path(tmp_path, npy(tmp_path, [[0, 0], [10, 20]])))
    expected = [[-2.0, 3.0], [-4.575, 5.075], [-3.075, 8.075], [-2.0, 13.0]]
    assert world.path is not None
    np.testing.assert_allclose(world.path, expected)


def test_a_world_without_a_path_beside_it(tmp_path: Path) -> None:
    path = world_with_path(tmp_path, b"")
    (tmp_path / "path_3.npy").unlink()
    assert files.load_world(path).path is None
    assert files.load_world(path.rename(tmp_path / "other.world")).path is None


HEADER = b"\x93NUMPY\x01\x00\x80\x00%-127s\n"


@pytest.mark.parametrize(
    "cells",
    [
        *([1, 2, 3], [[1, 2, 3]], [[math.nan, 1.0]], [["a", "b"]], [[1j, 2]]),
        *([[10**9, 0]], [[-(2**63), 0]], [[0, 0]] * 20_001),
        *(b"", b"PK\x03\x04", b"\x80\x04K\x01."),
        HEADER % b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000, 2), }",
        HEADER % b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 2), }",
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

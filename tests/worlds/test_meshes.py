"""Meshes of Gazebo worlds: their outlines, units and parts, and files that mean harm."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import trimesh as untyped_trimesh

from acsar_gym.errors import MissingExtraError, WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.files import Placement

trimesh: Any = untyped_trimesh
TABLE = [  # size, middle
    ((1.0, 0.6, 0.05), (0.0, 0.0, 0.725)),
    *(((0.1, 0.1, 0.7), (x, y, 0.35)) for x in (-0.4, 0.4) for y in (-0.2, 0.2)),
]
KERB = [((2.0, 0.3, 0.12), (0.0, 0.0, 0.06))]


def make_boxes(boxes: Any) -> list[Any]:
    made = []
    for size, middle in boxes:
        box = trimesh.creation.box(size)
        box.apply_translation(middle)
        made.append(box)
    return made


def write_mesh(path: Path, boxes: Any, unit: float = 1.0) -> None:
    parts = make_boxes(boxes)
    if path.suffix.lower() == ".dae":
        for part in parts:
            part.apply_scale(1.0 / unit)
        data = trimesh.exchange.dae.export_collada(parts).decode()
        tag = f'<unit name="other" meter="{unit}"/><up_axis>'
        path.write_text(data.replace("<up_axis>", tag), encoding="utf-8")
    else:
        trimesh.util.concatenate(parts).export(path, file_type=path.suffix[1:].lower())


def load(folder: Path, mesh: str, pose: str = "0 0 0 0 0 0") -> Any:
    """The segments of a mesh in a world."""
    path = folder / "hall.sdf"
    path.write_text(
        f"<sdf version='1.9'><world name='w'><model name='m'><pose>{pose}</pose><link name='l'>"
        f"<collision name='c'><geometry><mesh>{mesh}</mesh></geometry></collision></link></model>"
        "</world></sdf>",
        encoding="utf-8",
    )
    return files.load_world(path, Placement(start=(9, 9, 0), goal=(9, 8))).segments


def corners(segments: Any) -> Any:
    return sorted(set(map(tuple, segments[:, :2].round(3).tolist())))


def boxed(boxes: Any) -> Any:
    return sorted(
        (round(x + sx * width / 2.0, 3), round(y + sy * depth / 2.0, 3))
        for (width, depth, _), (x, y, _) in boxes
        for sx in (-1, 1)
        for sy in (-1, 1)
    )


@pytest.mark.parametrize("name", ["table.stl", "table.obj", "table.dae", "table.DAE", "table.STL"])
def test_a_mesh_is_cut_at_the_lidars_height(name: str, tmp_path: Path) -> None:
    write_mesh(tmp_path / name, TABLE)
    segments = load(tmp_path, f"<uri>{name}</uri>")
    assert corners(segments) == boxed(TABLE[1:]), "its legs"
    assert len(segments) == 16


def test_a_world_as_packages_publish_them(tmp_path: Path) -> None:
    """Worlds beside models, whose meshes name the model, in models that include models."""
    (tmp_path / "worlds").mkdir()
    for name, inside in (
        ("table", "<mesh><uri>model://table/meshes/Table_collision.DAE</uri></mesh>"),
        ("pillar", "<cylinder><radius>0.15</radius><length>0.5</length></cylinder>"),
    ):
        (tmp_path / "models" / name / "meshes").mkdir(parents=True)
        (tmp_path / "models" / name / "model.config").write_text(
            "<?xml version='1.0'?><model><sdf version='1.6'>model.sdf</sdf></model>"
        )
        (tmp_path / "models" / name / "model.sdf").write_text(
            f"<sdf version='1.6'><model name='x'><static>1</static><link name='l'><collision "
            f"name='c'><pose>0 0 0.1 0 0 0</pose><geometry>{inside}</geometry></collision></link>"
            "</model></sdf>"
        )
    write_mesh(tmp_path / "models" / "table" / "meshes" / "Table_collision.DAE", TABLE, 0.0254)
    (tmp_path / "worlds" / "cafe.world").write_text(
        "<?xml version='1.0' encoding='utf-8'?><!-- a cafe --><sdf version='1.6'>"
        "<world name='default'><include><uri>model://sun</uri></include><gui/>"
        "<physics type='ode' name='p' default='true'/><scene><sky/></scene>"
        "<plugin name='init' filename='libgazebo_ros_init.so'/>"
        "<model name='corner'><include><uri>model://table</uri><pose>1 0 0 0 0 0</pose></include>"
        "<include><name>p2</name><uri>model://pillar</uri></include>"
        "<pose frame=''>0 3 0 0 0 0</pose></model><include><name>Pillar</name><uri>model://pillar</uri></include>"
        "<state world_name='default'><model name='Pillar'><pose>-4 0 0 0 0 0</pose></model></state>"
        "</world></sdf>",
        encoding="utf-8",
    )
    ends = Placement(start=(9, 9, 0), goal=(9, 8))
    world = files.load_world(tmp_path / "worlds" / "cafe.world", ends)
    assert sorted(world.circles.tolist()) == [[-4.0, 0.0, 0.15], [0.0, 3.0, 0.15]]
    legs = [(size, (x + 1.0, y + 3.0, z)) for size, (x, y, z) in TABLE[1:]]
    assert corners(world.segments) == boxed(legs)


@pytest.mark.parametrize("suffix", [".stl", ".dae"])
def test_what_is_lower_than_the_lidar_is_outlined_where_it_is(suffix: str, tmp_path: Path) -> None:
    write_mesh(tmp_path / f"kerb{suffix}", KERB)
    segments = load(tmp_path, f"<uri>kerb{suffix}</uri>")
    assert corners(segments) == boxed(KERB)
    assert len(segments) == 4
    assert not len(load(tmp_path, f"<uri>kerb{suffix}</uri>", "0 0 -0.115 0 0 0")), "a floor"
    assert not len(load(tmp_path, f"<uri>kerb{suffix}</uri>", "0 0 0.6 0 0 0")), "a beam"


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("m.dae", b"", "isn't a sound DAE file"),
        ("m.dae", b"<COLLADA/>", "isn't a sound DAE file"),
        ("m.dae", b"<!DOCTYPE a [<!ENTITY b 'c'>]><COLLADA>&b;</COLLADA>", "entities"),
        ("m.stl", b"", "has no triangles|isn't a sound STL"),
        ("m.stl", b"solid x\nendsolid\n", "no triangles|isn't a sound STL"),
        ("m.stl", bytes(80) + b"\xff\xff\xff\xff", "has no triangles|isn't a sound STL"),
        ("m.obj", b"f 1 2 3\n", "isn't a sound OBJ file|no triangles"),
        ("m.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 1\nf 1 2 3\n", "isn't a sound OBJ"),
        ("m.glb", b"glTF", "a mesh is read from .dae, .stl, .obj"),
    ],
)
def test_broken_and_hostile_meshes_are_refused(
    name: str, data: bytes, said: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(WorldError, match=said) as caught:
        load(tmp_path, f"<uri>{name}</uri>")
    assert f"model 'm': mesh '{name}'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_trimesh_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mesh(tmp_path / "table.stl", TABLE)
    for module in ("trimesh", "collada"):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, module, None)
            with pytest.raises(MissingExtraError, match=r"acsar_gym\[meshes\]"):
                load(tmp_path, "<uri>table.stl</uri>")

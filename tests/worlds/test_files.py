"""The project's own world files: exact round trips, folders, and files that mean harm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.files import load_folder, load_world, save_world
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.world import Region, World

GOOD: dict[str, Any] = {
    "name": "three pillars",
    "circles": [[2.0, 0.3, 0.1], [3, -0.4, 0.1]],
    "segments": [[0.0, 1.0, 4.0, 1.0]],
    "start": {"x": 0.0, "y": 0.0, "theta": 0.5, "radius": 0.1},
    "goal": {"x": 4.0, "y": 0.0, "radius": 0.25},
    "path": [[0.0, 0.0], [4.0, 0.0]],
}
ENDS = "start: {x: 0.0, y: 0.0}\ngoal: {x: 1.0, y: 0.0}\n"
SUFFIXES = (".json", ".yaml", ".yml")


def content(world: World) -> tuple[object, ...]:
    """All of a world, to the bit."""
    arrays = (world.circles, world.segments, world.path)
    parts = [None if array is None else (array.shape, array.tobytes()) for array in arrays]
    return (*parts, repr((world.start, world.goal, world.name)))


def refused(path: Path, text: str | bytes) -> str:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(WorldError) as caught:
        load_world(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("kind", ["clutter", "smooth_path"])
def test_what_is_saved_is_loaded_bit_for_bit(kind: str, suffix: str, tmp_path: Path) -> None:
    world = generate_world(kind, 7)
    save_world(world, tmp_path / f"round{suffix}")
    assert content(load_world(tmp_path / f"round{suffix}")) == content(world)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_json_is_yaml_too(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"pillars{suffix}"
    path.write_text(json.dumps(GOOD), encoding="utf-8")
    world = load_world(path)
    assert world.name == "three pillars"
    assert world.circles.tolist() == [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]
    assert world.segments.tolist() == [[0.0, 1.0, 4.0, 1.0]]
    assert (world.start, world.goal) == (Region(0.0, 0.0, 0.1, 0.5), Region(4.0, 0.0, 0.25))
    assert world.length == 4.0


def test_what_may_be_left_out(tmp_path: Path) -> None:
    path = tmp_path / "Empty.YAML"
    path.write_text(f"\ufeff{ENDS}path: null\n", encoding="utf-8")
    world = load_world(path)
    assert (world.obstacles, world.path, world.name) == (0, None, "Empty")
    assert (world.start, world.goal) == (Region(0.0, 0.0), Region(1.0, 0.0))


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"cirles": []}, "'cirles'; did you mean 'circles'?"),
        ({"start": None}, "start: {x: 0.0, y: 0.0}"),
        ({"goal": {"x": 0, "y": 0, "theta": 1}}, "goal.theta"),
        ({"circles": None}, "circles = None: must be a valid list"),
        ({"circles": [[1, 10**99, 2]]}, "circles: must be finite numbers of at most 10000"),
        ({"circles": [[0, 0, 0]] * 20_001}, "at most 20,000"),
    ],
)
def test_bad_fields_are_refused(
    suffix: str, changes: dict[str, Any], field: str, tmp_path: Path
) -> None:
    assert field in refused(tmp_path / f"bad{suffix}", json.dumps({**GOOD, **changes}))


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("bad.json", "{", "not valid JSON"),
        ("bad.json", "[1, 2]", "must be a mapping with name"),
        ("bad.json", b" " * (files.MAX_TEXT_BYTES + 1), "larger than 5 MB"),
        ("bad.yaml", ENDS + "circles: [[.nan, 0, 1]]", "circles: must be finite numbers"),
    ],
)
def test_bad_texts_are_refused(name: str, text: str | bytes, problem: str, tmp_path: Path) -> None:
    assert problem in refused(tmp_path / name, text)


@pytest.mark.parametrize("name", ["world", "map.png"])
def test_other_suffixes_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"read from \.world, \.sdf, \.yaml, \.yml, \.json"):
        load_world(tmp_path / name)
    with pytest.raises(WorldError, match=r"saved as \.json, \.yaml or \.yml"):
        save_world(World(), tmp_path / name)


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for number, name in enumerate(("2.json", "10.yaml", "world_1.yml", "world_2.json")):
        save_world(World(name=str(number)), tmp_path / name)
    save_world(World(name="4"), tmp_path / "world_10.json")
    for name in ("README.md", "path_2.npy", ".hidden.json", "map.pgm"):
        (tmp_path / name).write_text("no world", encoding="utf-8")
    assert [world.name for world in load_folder(tmp_path)] == list("01234")


def test_folders_without_worlds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="holds no worlds"):
        load_folder(tmp_path)
    (tmp_path / "file.json").write_text("{}", encoding="utf-8")
    for name in ("nowhere", "file.json"):
        with pytest.raises(WorldError, match=f"{name}: can't be read: No"):
            load_folder(tmp_path / name)

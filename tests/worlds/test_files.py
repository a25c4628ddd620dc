"""The project's own world files: exact round trips, what people write, and one-line errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.files import format_world, load_folder, load_world, save_world
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.mover_files import parse_movers
from acsar_gym.worlds.movers import WALKING_SPEED, Mover, Repeat
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
SUFFIXES = pytest.mark.parametrize("suffix", [".json", ".yaml"])


def content(world: World) -> list[object]:
    """All of a world, to the bit."""
    arrays = [world.circles, world.segments, world.path, *(m.pieces for m in world.movers)]
    parts = [None if array is None else (array.shape, array.tobytes()) for array in arrays]
    names = ("duration", "radius", "repeat", "phase", "spread", "reacts", "sees_robot")
    fields = [getattr(mover, name) for mover in world.movers for name in names]
    return [*parts, repr((world.start, world.goal, world.name, fields))]


def refused(path: Path, text: str | bytes) -> str:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(WorldError) as caught:
        load_world(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


@SUFFIXES
@pytest.mark.parametrize("kind", ["clutter", "smooth_path", "crowd_reacting", "dynabarn"])
def test_load_world_reads_what_was_saved_bit_for_bit(
    kind: str, suffix: str, tmp_path: Path
) -> None:
    world = generate_world(kind, 7)
    save_world(world, tmp_path / f"round{suffix}")
    assert content(load_world(tmp_path / f"round{suffix}")) == content(world)


@pytest.mark.parametrize("suffix", [".json", ".yaml", ".yml"])
def test_load_world_reads_json_as_yaml_too(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"pillars{suffix}"
    path.write_text(json.dumps(GOOD), encoding="utf-8")
    world = load_world(path)
    assert world.name == "three pillars"
    assert world.circles.tolist() == [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]
    assert world.segments.tolist() == [[0.0, 1.0, 4.0, 1.0]]
    assert (world.start, world.goal) == (Region(0.0, 0.0, 0.1, 0.5), Region(4.0, 0.0, 0.25))
    assert world.length == 4.0


def test_load_world_needs_only_start_and_goal(tmp_path: Path) -> None:
    path = tmp_path / "Empty.YAML"
    path.write_text(f"\ufeff{ENDS}path: null\n", encoding="utf-8")
    world = load_world(path)
    assert (world.obstacles, world.path, world.name) == (0, None, "Empty")
    assert (world.start, world.goal) == (Region(0.0, 0.0), Region(1.0, 0.0))


@SUFFIXES
@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"cirles": []}, "'cirles'; did you mean 'circles'?"),
        ({"start": None}, "start: {x: 0.0, y: 0.0}"),
        ({"goal": {"x": 0, "y": 0, "theta": 1}}, "goal.theta"),
        ({"circles": [[1, 10**99, 2]]}, "circles: must be finite numbers of at most 10000"),
        ({"circles": [[0, 0, 0]] * 20_001}, "at most 20,000"),
    ],
)
def test_load_world_refuses_bad_fields(
    suffix: str, changes: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    assert problem in refused(tmp_path / f"bad{suffix}", json.dumps({**GOOD, **changes}))


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("bad.json", "{", "not valid JSON"),
        ("bad.json", "[1, 2]", "must be a mapping with name"),
        ("bad.json", b" " * (files.MAX_TEXT_BYTES + 1), "larger than 5 MB"),
        ("bad.yaml", ENDS + "circles: [[.nan, 0, 1]]", "circles: must be finite numbers"),
    ],
)
def test_load_world_refuses_bad_texts(
    name: str, text: str | bytes, problem: str, tmp_path: Path
) -> None:
    assert problem in refused(tmp_path / name, text)


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    with pytest.raises(WorldError, match=r"read from \.world, \.sdf, \.yaml, \.yml, \.json"):
        load_world(path)
    with pytest.raises(WorldError, match=r"saved as \.json, \.yaml or \.yml"):
        save_world(World(), path)


def test_load_folder_reads_worlds_in_natural_order(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="holds no worlds"):
        load_folder(tmp_path)
    names = "2.json", "10.yaml", "world_1.yml", "world_2.json", "world_10.json"
    for number, name in enumerate(names):
        save_world(World(name=str(number)), tmp_path / name)
    for name in ("README.md", "path_2.npy", ".hidden.json", "map.pgm"):
        (tmp_path / name).write_text("no world", encoding="utf-8")
    assert [world.name for world in load_folder(tmp_path)] == list("01234")
    for name in ("nowhere", "2.json"):
        with pytest.raises(WorldError, match=f"{name}: can't be read: No"):
            load_folder(tmp_path / name)


# Movers


def parse(**fields: Any) -> Mover:
    (mover,) = parse_movers([fields])
    return mover


def test_parse_movers_reads_what_people_write() -> None:
    nurse = parse(name="nurse", points=[[0, 2], [6, 2]], speed=1.5, pauses=[1.0, 0.0])
    assert nurse.position(3.0) == pytest.approx((3.0, 2.0))
    assert (nurse.repeat, nurse.name, nurse.radius) == (Repeat.BACK, "nurse", 0.25)
    cart = parse(radius=0.4, times=[0, 3, 5], points=[[1, 0], [1, 3], [4, 3]])
    assert cart.position(4.0) == pytest.approx((2.5, 3.0))
    assert (cart.repeat, cart.radius) == (Repeat.LOOP, 0.4)
    ball = parse(duration=4.0, pieces=[[0, 0, 1, 0, 0, 0, 0, 0.5, 0]], repeat="stop")
    assert ball.position(9.0) == (4.0, 8.0)
    guard = parse(points=[[3, -1]], reacts=True, sees_robot=False)
    assert guard.position(5.0) == (3.0, -1.0)
    assert (guard.reacts, guard.sees_robot) == (True, False)
    assert parse(points=[[0, 0], [9, 0]]).top_speed == pytest.approx(WALKING_SPEED)
    smooth = parse(times=[0, 1, 2], points=[[0, 0], [1, 0], [1, 1]], smooth=True)
    assert np.any(smooth.pieces[:, [3, 4, 7, 8]])


@pytest.mark.parametrize(
    ("mover", "problem"),
    [
        ({"point": [[0, 0]]}, "unknown field 'point'; did you mean 'points'?"),
        ({}, "needs points and a speed, points and times, or pieces and a duration; has none"),
        ({"points": [[0, 0], [1, 0]], "times": [0, 1], "speed": 1.0}, "has points, speed, times"),
        ({"points": [[0, 0], [1, 0]], "speed": 99.0}, "moves at 99.0 m/s, at most 20"),
        ({"points": [[0, 10**400]]}, "needs points (x, y)"),
        ({"duration": 1.0, "pieces": [[0, 1]]}, "pieces must be rows of 9 finite numbers"),
    ],
)
def test_load_world_names_a_bad_mover(mover: Any, problem: str, tmp_path: Path) -> None:
    text = json.dumps({**GOOD, "movers": [{"points": [[0, 0]]}, mover]})
    message = refused(tmp_path / "bad.json", text)
    assert message.startswith("movers.1: ")
    assert problem in message


def test_format_world_leaves_out_movers_if_there_are_none() -> None:
    assert b"movers" not in format_world(World(), ".yaml") + format_world(World(), ".json")

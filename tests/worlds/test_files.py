"""The project's own world files: exact round trips, what people write, and one-line errors."""

from __future__ import annotations

import json
from dataclasses import asdict
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


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def assert_refused(path: Path, text: str | bytes, problem: str) -> None:
    with pytest.raises(WorldError) as caught:
        load_world(write(path, text))
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert problem in message
    assert "\n" not in message


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
@pytest.mark.parametrize("kind", ["clutter", "smooth_path", "crowd_reacting"])
def test_load_world_reads_what_was_saved_bit_for_bit(
    kind: str, suffix: str, tmp_path: Path
) -> None:
    world = generate_world(kind, 7)
    save_world(world, tmp_path / f"round{suffix}")
    copied = load_world(tmp_path / f"round{suffix}")
    with np.printoptions(floatmode="unique", threshold=10**9):
        assert repr(asdict(copied)) == repr(asdict(world))


def test_load_world_reads_json_as_yaml_too(tmp_path: Path) -> None:
    world = load_world(write(tmp_path / "pillars.yml", json.dumps(GOOD)))
    assert world.name == "three pillars"
    assert world.circles.tolist() == GOOD["circles"]
    assert world.segments.tolist() == GOOD["segments"]
    assert (world.start, world.goal) == (Region(0.0, 0.0, 0.1, 0.5), Region(4.0, 0.0, 0.25))
    assert world.length == 4.0


def test_load_world_needs_only_start_and_goal(tmp_path: Path) -> None:
    world = load_world(write(tmp_path / "Empty.YAML", f"\ufeff{ENDS}path: null\n"))
    assert (world.obstacles, world.path, world.name) == (0, None, "Empty")
    assert (world.start, world.goal) == (Region(0.0, 0.0), Region(1.0, 0.0))
    text = "start: {x: 0, y: 0, radius: , theta: }\ngoal: {x: 1, y: 0, radius: null}"
    assert load_world(write(tmp_path / "null.yaml", text)).start == Region(0.0, 0.0)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"cirles": []}, "'cirles'; did you mean 'circles'?"),
        ({"start": None}, "start: {x: 0.0, y: 0.0}"),
        ({"goal": {"x": 0, "y": 0, "theta": 1}}, "goal.theta"),
        ({"circles": [[1, 10**99, 2]]}, "circles: must be finite numbers of at most 10000"),
        ({"circles": [[1, 2, 3], [1, 2]]}, "'circles.1.2' is missing"),
        ({"segments": [[1, 2, 3, 4], [1, None, 3, 4]]}, "segments.1.1 = None"),
    ],
)
def test_load_world_refuses_bad_fields(
    changes: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    assert_refused(tmp_path / "bad.json", json.dumps({**GOOD, **changes}), problem)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("bad.json", "{", "not valid JSON"),
        ("bad.json", b" " * (files.MAX_TEXT_BYTES + 1), "larger than 5 MB"),
        ("bad.yaml", ENDS + "circles: [[.nan, 0, 1]]", "circles.0.0 = nan: must be a finite"),
        ("bad.png", ENDS, "read from .world, .sdf, .yaml, .yml, .json"),
    ],
)
def test_load_world_refuses_bad_texts(
    name: str, text: str | bytes, problem: str, tmp_path: Path
) -> None:
    assert_refused(tmp_path / name, text, problem)


def test_load_folder_reads_worlds_in_natural_order(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="holds no worlds"):
        load_folder(tmp_path)
    names = "2.json", "10.yaml", "world_1.yml", "world_2.json", "world_10.json"
    for number, name in enumerate(names):
        save_world(World(name=str(number)), tmp_path / name)
    for name in ("README.md", "path_2.npy", ".hidden.json", "map.pgm"):
        write(tmp_path / name, "no world")
    assert [world.name for world in load_folder(tmp_path)] == list("01234")
    with pytest.raises(WorldError, match="nowhere: can't be read: No"):
        load_folder(tmp_path / "nowhere")


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
    ],
)
def test_load_world_names_a_bad_mover(mover: Any, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    text = json.dumps({**GOOD, "movers": [{"points": [[0, 0]]}, mover]})
    assert_refused(path, text, problem)
    with pytest.raises(WorldError, match=r"movers\.1: "):
        load_world(path)


def test_format_world_leaves_out_movers_and_refuses_other_suffixes() -> None:
    assert b"movers" not in format_world(World(), ".yaml") + format_world(World(), ".json")
    with pytest.raises(WorldError, match=r"saved as \.json, \.yaml or \.yml"):
        format_world(World(), ".png")

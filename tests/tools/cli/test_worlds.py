"""Worlds of files without a start and a goal: commands take --start and --goal."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym.worlds import Region
from acsar_gym.worlds.files import load_world

WALLS = ((0.0, 2.0, 4.0, 0.1), (0.0, -2.0, 4.0, 0.1), (2.0, 0.0, 0.1, 4.0), (-2.0, 0.0, 0.1, 4.0))
MAP = "image: map.pgm\nresolution: 0.05\norigin: [-2.0, -2.0, 0.0]\nnegate: 0\n"
MAP += "occupied_thresh: 0.65\nfree_thresh: 0.25\nmode: trinary\n"
PLACED = ("--start", "-1,-1,0.5", "--goal", "1.2,1")


def write_room(folder: Path, kind: str) -> Path:
    """A closed room of 4 x 4 m around the origin, as a Gazebo world, or as a map."""
    if kind == "map":
        rows = [
            bytes(0 if {row, column} & {0, 79} else 254 for column in range(80))
            for row in range(80)
        ]
        (folder / "map.pgm").write_bytes(b"P5\n80 80\n255\n" + b"".join(rows))
        (folder / "map.yaml").write_text(MAP, encoding="utf-8")
        return folder / "map.yaml"
    walls = "".join(
        f"<collision name='c{number}'><pose>{x} {y} 0.5 0 0 0</pose><geometry><box>"
        f"<size>{length} {width} 1</size></box></geometry></collision>"
        for number, (x, y, length, width) in enumerate(WALLS)
    )
    path = folder / "hall.sdf"
    path.write_text(
        "<sdf version='1.9'><world name='w'><model name='room'>"
        f"<link name='l'>{walls}</link></model></world></sdf>",
        encoding="utf-8",
    )
    return path


@pytest.fixture(params=["gazebo", "map"])
def room(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The file of a world without start and goal."""
    return str(write_room(tmp_path, request.param))


def test_a_world_without_start_and_goal_is_refused_by_every_command(
    room: str, call: Call, tmp_path: Path
) -> None:
    out = str(tmp_path / "out.json")
    for command in (
        ("worlds", "check", room),
        ("worlds", "show", room, "--out", str(tmp_path / "out.png")),
        ("worlds", "convert", room, out),
        ("evaluate", "--policy", "obstacle_goal", "--link", "planar", "--worlds", room),
        ("emulate", "--duration", "0.1", "--world", room),
    ):
        code, _, error = call(*command)
        assert code == 2, command
        assert_one_line(error, "has no start")
        assert "--start X,Y,THETA" in error
        code, _, error = call(*command, "--start", "-1,0")
        assert code == 2, command
        assert_one_line(error, "has no goal")


def test_start_and_goal_of_options_are_the_worlds(room: str, call: Call, tmp_path: Path) -> None:
    code, output, error = call("worlds", "check", room, *PLACED)
    assert (code, error) == (0, "")
    assert "2.97" in output, "the straight line between them"
    code, output, _ = call("worlds", "check", room, "--start", "-1,-1", "--goal", "3,0")
    assert code == 1
    assert "no way from start to goal" in " ".join(output.split())
    for name in ("room.yaml", "room.json"):
        out = tmp_path / name
        assert call("worlds", "convert", room, out, *PLACED)[0] == 0
        world = load_world(out)
        assert (world.start, world.goal) == (Region(-1.0, -1.0, 0.0, 0.5), Region(1.2, 1.0))
        assert world.obstacles >= 8
    picture = tmp_path / "room.png"
    assert call("worlds", "show", room, "--out", picture, *PLACED)[0] == 0
    assert picture.stat().st_size > 1000


def test_a_policy_drives_from_that_start(room: str, call: Call, tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    evaluate = ("evaluate", "--policy", "obstacle_goal", "--link", "planar", "--episodes", "1")
    code, output, error = call(*evaluate, "--worlds", room, *PLACED, "--json", out)
    assert (code, error) == (0, "")
    assert Path(room).name.partition(".")[0] in output
    header = json.loads(out.read_text())["header"]
    assert header["env"]["kwargs"]["worlds"]["start"] == PLACED[1]
    assert header["worlds"]["kind"] == room


@pytest.mark.parametrize("option", ["--start", "--goal"])
def test_these_options_are_for_worlds_of_files(option: str, call: Call) -> None:
    for command in (("worlds", "check", "clutter:2"), ("worlds", "show", "barn:1")):
        code, _, error = call(*command, option, "1,2")
        assert code == 2
        assert_one_line(error, "generated worlds have a start and a goal of their own")
    code, _, error = call("evaluate", "--link", "planar", option, "1,2")
    assert code == 2
    assert_one_line(error, f"{option} is for a world of a file: name one file, too")

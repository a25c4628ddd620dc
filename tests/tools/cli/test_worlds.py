"""Worlds of files without a start and a goal, which `worlds convert` adds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from acsar_gym.worlds import Region
from acsar_gym.worlds.files import load_world

MAP = "image: map.pgm\nresolution: 0.05\norigin: [-2.0, -2.0, 0.0]\nnegate: 0\n"
MAP += "occupied_thresh: 0.65\nfree_thresh: 0.25\nmode: trinary\n"


def write_map(folder: Path) -> Path:
    """Write a closed room of 4 x 4 m around the origin as a ROS map."""
    rows = [
        bytes(0 if {row, column} & {0, 79} else 254 for column in range(80)) for row in range(80)
    ]
    (folder / "map.pgm").write_bytes(b"P5\n80 80\n255\n" + b"".join(rows))
    (folder / "map.yaml").write_text(MAP, encoding="utf-8")
    return folder / "map.yaml"


def test_worlds_convert_adds_start_and_goal(call: Any, tmp_path: Path) -> None:
    room = write_map(tmp_path)
    evaluate = "evaluate --policy obstacle_goal --link planar --episodes 1 --worlds"
    for line in (f"worlds check {room}", f"{evaluate} {room}"):
        call.refuse("has no start and no goal: run 'acsar-gym worlds convert FILE", line)

    out = tmp_path / "room.yaml"
    convert = f"worlds convert {room} {out} --start -1,-1,0.5"
    call.refuse("has no goal", convert)
    assert call(f"{convert} --goal 1.2,1")[0] == 0
    world = load_world(out)
    assert (world.start, world.goal) == (Region(-1.0, -1.0, 0.0, 0.5), Region(1.2, 1.0))
    assert world.obstacles >= 8

    text = call.succeed(f"worlds check {out}")
    assert "2.97" in text, "the straight line between them"
    result = tmp_path / "figures.json"
    call.succeed(f"{evaluate} {out} --json {result}")
    assert json.loads(result.read_text())["header"]["worlds"]["sets"].startswith(str(out))


def test_worlds_check_finds_a_goal_outside(call: Any, tmp_path: Path) -> None:
    out = tmp_path / "room.json"
    call.succeed(f"worlds convert {write_map(tmp_path)} {out} --start -1,-1 --goal 3,0")
    code, text, _ = call(f"worlds check {out}")
    assert code == 1
    assert "no way from start to goal" in " ".join(text.split())


def test_worlds_convert_refuses_ends_for_generated_worlds(call: Any) -> None:
    convert = "worlds convert clutter:2-2 out.yaml --start 1,2"
    call.refuse("generated worlds have a start and a goal of their own", convert)

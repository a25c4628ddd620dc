"""Movers in files: exact round trips, what people write, and errors of one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds.files import format_world, load_world, save_world
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.mover_files import parse_movers
from acsar_gym.worlds.movers import WALKING_SPEED, Mover, Repeat
from acsar_gym.worlds.world import World


def content(mover: Mover) -> tuple[object, ...]:
    """All of a mover, to the bit."""
    return (
        mover.pieces.tobytes(),
        mover.pieces.shape,
        *(
            repr(getattr(mover, field))
            for field in ("duration", "radius", "repeat", "phase", "spread", "reacts", "sees_robot")
        ),
    )


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
@pytest.mark.parametrize("kind", ["crowd_reacting", "dynabarn"])
def test_what_is_saved_is_loaded_bit_for_bit(kind: str, suffix: str, tmp_path: Path) -> None:
    world = generate_world(kind, 7)
    save_world(world, tmp_path / f"round{suffix}")
    again = load_world(tmp_path / f"round{suffix}")
    assert list(map(content, again.movers)) == list(map(content, world.movers))


def test_what_people_write() -> None:
    nurse, cart, ball, guard = parse_movers(
        [
            {"name": "nurse", "points": [[0, 2], [6, 2]], "speed": 1.5, "pauses": [1.0, 0.0]},
            {"radius": 0.4, "times": [0, 3, 5], "points": [[1, 0], [1, 3], [4, 3]]},
            {"duration": 4.0, "pieces": [[0, 0, 1, 0, 0, 0, 0, 0.5, 0]], "repeat": "stop"},
            {"points": [[3, -1]], "reacts": True, "sees_robot": False},
        ]
    )

    assert nurse.position(3.0) == pytest.approx((3.0, 2.0))
    assert (nurse.repeat, nurse.name, nurse.radius) == (Repeat.BACK, "nurse", 0.25)
    assert cart.position(4.0) == pytest.approx((2.5, 3.0))
    assert (cart.repeat, cart.radius) == (Repeat.LOOP, 0.4)
    assert ball.position(9.0) == (4.0, 8.0)
    assert guard.position(5.0) == (3.0, -1.0)
    assert (guard.reacts, guard.sees_robot) == (True, False)

    (usual,) = parse_movers([{"points": [[0, 0], [9, 0]]}])
    assert usual.top_speed == pytest.approx(WALKING_SPEED)
    (smooth,) = parse_movers(
        [{"times": [0, 1, 2], "points": [[0, 0], [1, 0], [1, 1]], "smooth": True}]
    )
    assert np.any(smooth.pieces[:, [3, 4, 7, 8]])


@pytest.mark.parametrize(
    ("mover", "problem"),
    [
        ({"point": [[0, 0]]}, "unknown field 'point'; did you mean 'points'?"),
        ({}, "needs points and a speed, points and times, or pieces and a duration; has none"),
        ({"points": [[0, 0], [1, 0]], "times": [0, 1], "speed": 1.0}, "has points, speed, times"),
        ({"points": [[0, 0], [1, 0]], "times": [1, 0]}, "needs two times or more, growing"),
        ({"points": [[0, 0], [1, 0]], "speed": 99.0}, "moves at 99.0 m/s, at most 20"),
        ({"points": [[0, 10**400]]}, "needs points (x, y)"),
        ({"points": [[0, 1e9]]}, "its places must be at most 10000 m"),
        ({"duration": 1.0, "pieces": [[0, 1]]}, "pieces must be rows of 9 finite numbers"),
    ],
)
def test_bad_movers_are_one_line_that_names_them(mover: Any, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    ends = {"start": {"x": 0, "y": 0}, "goal": {"x": 1, "y": 0}}
    path.write_text(json.dumps({**ends, "movers": [{"points": [[0, 0]]}, mover]}))
    with pytest.raises(WorldError) as caught:
        load_world(path)
    assert str(caught.value).startswith(f"{path}: movers.1: ")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_standing_worlds_are_written_as_before() -> None:
    assert b"movers" not in format_world(World(), ".yaml") + format_world(World(), ".json")

"""Motions of movers: closed forms by hand, properties, and errors."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import World
from acsar_gym.worlds.movers import (
    MAX_MOVERS,
    Mover,
    Repeat,
    follow_keys,
    walk,
)

NEAR = 1e-9
BOTH_WAYS = walk([[0, 0], [4, 0], [4, 2]], [1.0, 2.0], pauses=[0.5, 0.0, 1.0])
"""0.5 s of rest, 4 s, 1 s, 1 s of rest, and back the same way."""
AROUND = walk([[0, 0], [3, 0], [3, 4]], 1.0, repeat=Repeat.LOOP)
"""3 s, 4 s, and 5 s on to the first point."""
ONCE = walk([[0, 0], [3, 0]], 1.0, repeat=Repeat.STOP)
WAVE = [[0.0, 0.0], [1.0, 0.5], [1.5, -0.5], [0.5, -1.0]]
SPLINE = follow_keys([2.0, 3.0, 5.0, 6.5], WAVE, smooth=True, repeat=Repeat.STOP)
CLOSED = follow_keys([0, 1, 2, 3], [[0, 0], [2, 0], [1, 2], [0, 0]], smooth=True)
"""As gz-math has it: both ends have the tangent of the neighbours beside the joint."""
SPLINES = [
    follow_keys([1.5, 2.0, 4.0, 5.5], WAVE, smooth=True, repeat=repeat, phase=3.0)
    for repeat in Repeat
]


@pytest.mark.parametrize(
    ("mover", "time", "place", "velocity"),
    [
        (BOTH_WAYS, 2.5, (2.0, 0.0), (1.0, 0.0)),
        (BOTH_WAYS, 8.0, (4.0, 1.0), (0.0, -2.0)),
        (BOTH_WAYS, 15.5, (2.0, 0.0), (1.0, 0.0)),
        (AROUND, 9.5, (1.5, 2.0), (-0.6, -0.8)),
        (ONCE, 1e6, (3.0, 0.0), (0.0, 0.0)),
        (walk([[2, 1], [2, 1]], pauses=3.0), 7.3, (2.0, 1.0), (0.0, 0.0)),
        (follow_keys([5, 6, 8], [[0, 0], [1, 0], [1, 4]]), 7.5, (1.0, 3.0), (0.0, 2.0)),
        (SPLINE, 2.0, WAVE[0], (0.5, 0.25)),
        (SPLINE, 3.0, WAVE[1], (0.375, -0.125)),
        (SPLINE, 5.0, WAVE[2], (-0.5 / 3.0, -0.5)),
        (CLOSED, 0.0, (0.0, 0.0), (0.5, -1.0)),
        (CLOSED, 3.0 - 1e-11, (0.0, 0.0), (0.5, -1.0)),
    ],
)
def test_motion_by_hand(mover: Mover, time: float, place: Any, velocity: Any) -> None:
    assert mover.position(time) == pytest.approx(place, abs=NEAR)
    assert mover.velocity(time) == pytest.approx(velocity, abs=NEAR)


@pytest.mark.parametrize("mover", [BOTH_WAYS, AROUND, ONCE, *SPLINES])
def test_velocity_top_speed_and_bounds_are_those_of_the_places(mover: Mover) -> None:
    times = np.arange(-5.0, 40.0, 0.01)
    places = np.array([mover.position(time) for time in times])
    velocities = np.array([mover.velocity(time) for time in times])
    steps = np.diff(places, axis=0) / 0.01

    # But for corners and jumps, of which there are few.
    errors = np.hypot(*(steps - (velocities[1:] + velocities[:-1]) / 2.0).T)
    assert np.quantile(errors, 0.97) < 1e-3
    fastest = np.hypot(*velocities.T).max()
    assert np.quantile(np.hypot(*steps.T), 0.99) <= fastest + 1e-6
    assert fastest - NEAR <= mover.top_speed <= 1.1 * fastest
    bounds = np.array([places.min(axis=0) - mover.radius, places.max(axis=0) + mover.radius])
    assert mover.bounds == pytest.approx(bounds.ravel(), abs=0.01 * fastest)


@pytest.mark.parametrize(
    ("repeat", "end"),
    [(Repeat.STOP, (4.0, 2.0)), (Repeat.BACK, (4.0, 0.0)), (Repeat.LOOP, (0.0, 0.0))],
)
def test_follow_keys_is_at_rest_until_its_first_time(repeat: Repeat, end: Any) -> None:
    mover = follow_keys([30.0, 34.0, 35.0], [[0, 0], [4, 0], [4, 2]], repeat=repeat)
    for time in (0.0, 29.9):
        assert mover.position(time) == mover.velocity(time) == (0.0, 0.0)
    for time, place in ((32.5, (2.5, 0.0)), (34.0, (4.0, 0.0)), (36.0, end)):
        assert mover.position(time) == pytest.approx(place)


LINE = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
POINTS = [[0, 0], [4, 0]]
BAD_WALK = r"needs .*points? \(x, y\)"
BAD_KEYS = "needs two times or more, growing, none"


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (Mover, {"pieces": LINE[:, :8]}, "pieces must be rows of 9 finite numbers"),
        (Mover, {"duration": 0.0}, r"end at its duration \(0 s\)"),
        (Mover, {"pieces": LINE * 1e308}, "moves at"),
        (Mover, {"pieces": LINE + np.eye(1, 9, 1) * 2e4}, "its places must be at most 10000 m"),
        (Mover, {"repeat": "loop"}, "repeat = 'loop': must be a Repeat"),
        (walk, {"speed": 0.0}, BAD_WALK),
        (follow_keys, {"times": [1.0, 1.0]}, BAD_KEYS),
        (follow_keys, {"times": [-1.0, 1.0]}, BAD_KEYS),
    ],
)
def test_motion_that_cannot_be_made_is_one_line(
    make: Any, arguments: dict[str, Any], message: str
) -> None:
    usual = {"pieces": LINE, "duration": 2.0} if make is Mover else {"points": POINTS}
    with pytest.raises(WorldError, match=message) as raised:
        make(**{**usual, "name": "Ann\nB", **arguments})
    assert str(raised.value).startswith(r"mover 'Ann\nB': ")
    assert "\n" not in str(raised.value)


def test_mover_never_changes() -> None:
    pieces = LINE.copy()
    mover = Mover(pieces, 2.0)
    pieces[0, 1] = 5.0
    assert mover.position(0.0) == (0.0, 0.0)
    with pytest.raises(ValueError, match="read-only"):
        mover.pieces[0, 1] = 5.0
    assert copy.deepcopy(mover).position(1.3) == mover.position(1.3)


def test_world_limits_its_movers() -> None:
    with pytest.raises(WorldError, match="movers: 201 are too many: at most 200, whose motions"):
        World(movers=[ONCE] * (MAX_MOVERS + 1))
    long = walk(np.random.default_rng(0).uniform(-1, 1, (6000, 2)))
    with pytest.raises(WorldError, match="10,000 pieces together"):
        World(movers=(long, long))
    with pytest.raises(WorldError, match=r"movers: .* must be of Mover"):
        World(movers=["Ann"])  # type: ignore[list-item]

"""Motions of movers: closed forms by hand, properties, and errors."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.errors import WorldError
from acsar_gym.worlds import World
from acsar_gym.worlds.movers import (
    MAX_MOVERS,
    Mover,
    Repeat,
    draw_offset,
    follow_keys,
    make_motions,
    walk,
)

NEAR = 1e-9
PLACES = st.tuples(*[st.integers(-40, 40).map(lambda n: n / 4.0)] * 2)
PHASES = st.floats(-5.0, 20.0)


@st.composite
def walks(draw: st.DrawFn) -> Mover:
    """Walks of any kind."""
    return walk(
        draw(st.lists(PLACES, min_size=1, max_size=6)),
        draw(st.floats(0.2, 3.0)),
        pauses=draw(st.one_of(st.just(0.0), st.floats(0.1, 2.0))),
        repeat=draw(st.sampled_from(Repeat)),
        phase=draw(PHASES),
        spread=draw(st.floats(0.0, 9.0)),
    )


@st.composite
def keyed(draw: st.DrawFn) -> Mover:
    """Motions through keys, smooth or not, that jump or not."""
    steps = draw(st.lists(st.floats(0.5, 3.0), min_size=1, max_size=5))
    count = len(steps) + 1
    return follow_keys(
        np.cumsum([draw(st.sampled_from([0.0, 1.5])), *steps]),
        np.array(draw(st.lists(PLACES, min_size=count, max_size=count))) / 10.0,
        smooth=draw(st.booleans()),
        tension=draw(st.floats(0.0, 1.0)),
        repeat=draw(st.sampled_from(Repeat)),
        phase=draw(PHASES),
    )


def ends_between(mover: Mover, since: float, until: float, ends: list[float]) -> bool:
    """Whether a mover is at one of these times of its motion between two times, or nearly."""
    cycle = mover.cycle if math.isfinite(mover.cycle) else 1e9
    first = since + mover.phase - 1e-6
    last = until + mover.phase + 1e-6
    return any(math.floor((last - end) / cycle) > math.floor((first - end) / cycle) for end in ends)


BOTH_WAYS = walk([[0, 0], [4, 0], [4, 2]], [1.0, 2.0], pauses=[0.5, 0.0, 1.0])
"""0.5 s of rest, 4 s, 1 s, 1 s of rest, and back the same way."""
AROUND = walk([[0, 0], [3, 0], [3, 4]], 1.0, repeat=Repeat.LOOP)
"""3 s, 4 s, and 5 s on to the first point."""
ONCE = walk([[0, 0], [3, 0]], 1.0, repeat=Repeat.STOP)


@pytest.mark.parametrize(
    ("mover", "time", "place", "velocity"),
    [
        (BOTH_WAYS, 2.5, (2.0, 0.0), (1.0, 0.0)),
        (BOTH_WAYS, 5.0, (4.0, 1.0), (0.0, 2.0)),
        (BOTH_WAYS, 8.0, (4.0, 1.0), (0.0, -2.0)),
        (BOTH_WAYS, 15.5, (2.0, 0.0), (1.0, 0.0)),
        (AROUND, 5.0, (3.0, 2.0), (0.0, 1.0)),
        (AROUND, 9.5, (1.5, 2.0), (-0.6, -0.8)),
        (ONCE, 1e6, (3.0, 0.0), (0.0, 0.0)),
        (walk([[2, 1]], repeat=Repeat.LOOP), 7.3, (2.0, 1.0), (0.0, 0.0)),
        (walk([[2, 1], [2, 1]], pauses=3.0), 7.3, (2.0, 1.0), (0.0, 0.0)),
        (follow_keys([5, 6, 8], [[0, 0], [1, 0], [1, 4]]), 7.5, (1.0, 3.0), (0.0, 2.0)),
    ],
)
def test_motion_by_hand(mover: Mover, time: float, place: Any, velocity: Any) -> None:
    assert mover.position(time) == pytest.approx(place, abs=NEAR)
    assert mover.velocity(time) == pytest.approx(velocity, abs=NEAR)


@given(st.one_of(walks(), keyed()), st.floats(-50.0, 200.0), st.floats(1e-4, 0.5))
def test_motion_is_continuous_and_its_velocity_is_its_derivative(
    mover: Mover, time: float, step: float
) -> None:
    jumps = mover.repeat == Repeat.LOOP and ends_between(mover, time, time + step, [0.0])
    if not jumps:
        length = math.dist(mover.position(time), mover.position(time + step))
        assert length <= mover.top_speed * step + NEAR

    keys = [*mover.pieces[:, 0], mover.duration]
    if mover.repeat == Repeat.BACK:
        keys += [2.0 * mover.duration - key for key in keys]
    if not ends_between(mover, time - 1e-4, time + 1e-4, keys):
        ends = np.array([mover.position(time + off) for off in (-1e-4, 1e-4)])
        assert mover.velocity(time) == pytest.approx((ends[1] - ends[0]) / 2e-4, abs=1e-5)


@given(st.one_of(walks(), keyed()))
def test_top_speed_and_bounds_hold_a_motion_and_hardly_more(mover: Mover) -> None:
    times = (np.linspace(0.0, mover.duration, 2000) - mover.phase).tolist()
    fastest = max(math.hypot(*mover.velocity(time)) for time in times)
    assert fastest - NEAR <= mover.top_speed <= 1.1 * fastest + NEAR

    places = np.array([mover.position(time) for time in times])
    low_corner, high_corner = np.array(mover.bounds).reshape(2, 2)
    gaps = np.stack([places.min(axis=0) - low_corner, high_corner - places.max(axis=0)])
    near = mover.top_speed * mover.duration / 1999.0 + NEAR
    assert (gaps >= mover.radius - NEAR).all()
    assert (gaps <= mover.radius + near).all()


@pytest.mark.parametrize("tension", [0.0, 0.4, 1.0])
def test_follow_keys_makes_a_spline_through_its_keys(tension: float) -> None:
    keys = np.array([[0.0, 0.0], [1.0, 0.5], [1.5, -0.5], [0.5, -1.0]])
    times = np.array([2.0, 3.0, 5.0, 6.5])
    mover = follow_keys(times, keys, smooth=True, tension=tension, repeat=Repeat.STOP)
    padded = np.concatenate([keys[:1], keys, keys[-1:]])
    for number, time in enumerate(times.tolist()):
        assert mover.position(time) == pytest.approx(keys[number], abs=NEAR)
        if number < len(keys) - 1:
            tangent = (1.0 - tension) / 2.0 * (padded[number + 2] - padded[number])
            expected = tangent / (times[number + 1] - time)
            assert mover.velocity(time) == pytest.approx(expected, abs=NEAR)


def test_follow_keys_makes_a_closed_spline_without_a_corner() -> None:
    """As gz-math has it: both ends have the tangent of the neighbours beside the joint."""
    closed = follow_keys([0, 1, 2, 3], [[0, 0], [2, 0], [1, 2], [0, 0]], smooth=True)
    leaving = closed.velocity(0.0)
    np.testing.assert_allclose(leaving, closed.velocity(3.0 - 1e-9), atol=1e-6)
    np.testing.assert_allclose(leaving, (0.5, -1.0))


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize(
    ("repeat", "end"),
    [(Repeat.STOP, (4.0, 2.0)), (Repeat.BACK, (4.0, 0.0)), (Repeat.LOOP, (0.0, 0.0))],
)
def test_follow_keys_is_at_rest_until_its_first_time(
    repeat: Repeat, end: Any, smooth: bool
) -> None:
    points = [[0, 0], [4, 0], [4, 2]]
    mover = follow_keys([30.0, 34.0, 35.0], points, repeat=repeat, smooth=smooth)
    for time in (0.0, 29.9):
        assert mover.position(time) == mover.velocity(time) == (0.0, 0.0)
    assert mover.position(34.0) == pytest.approx((4.0, 0.0))
    since_start = follow_keys([0.0, 4.0, 5.0], points, repeat=repeat, smooth=smooth)
    assert mover.position(32.5) == pytest.approx(since_start.position(2.5))
    assert mover.position(36.0) == pytest.approx(end)


def test_draw_offset_gives_each_episode_its_own_part_of_the_spread() -> None:
    mover = walk([[0, 0], [9, 0]], 1.0, phase=2.0, spread=5.0)
    rows = make_motions([[mover] * 3]).movers[0]
    offsets = [draw_offset(rows[m], m, key) for m in range(3) for key in (0.1, 0.6)]
    assert len(set(offsets)) == 6
    assert 2.0 <= min(offsets) < max(offsets) <= 7.0
    assert draw_offset(rows[0], 0, 0.1) == offsets[0]
    assert mover.position(0.0, (offsets[1] - 2.0) / 5.0) == pytest.approx((offsets[1], 0.0))


LINE = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
POINTS = [[0, 0], [4, 0]]
BAD_WALK = r"needs .*points? \(x, y\)"
BAD_KEYS = "needs two times or more, growing, none"


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (Mover, {"pieces": LINE[:, :8]}, "pieces must be rows of 9 finite numbers"),
        (Mover, {"pieces": np.concatenate([LINE, LINE])}, "its times must grow from 0 on"),
        (Mover, {"duration": 0.0}, r"end at its duration \(0 s\)"),
        (Mover, {"phase": math.nan}, "must be finite numbers"),
        (Mover, {"pieces": LINE * 1e308}, "moves at"),
        (Mover, {"pieces": LINE + np.eye(1, 9, 1) * 2e4}, "its places must be at most 10000 m"),
        (walk, {"points": []}, BAD_WALK),
        (walk, {"speed": 0.0}, BAD_WALK),
        (walk, {"speed": [1.0, 2.0, 3.0]}, BAD_WALK),
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
    assert World(movers=[ONCE, AROUND]).movers == (ONCE, AROUND)
    with pytest.raises(WorldError, match="movers: 201 are too many: at most 200, whose motions"):
        World(movers=[ONCE] * (MAX_MOVERS + 1))
    long = walk(np.random.default_rng(0).uniform(-1, 1, (6000, 2)))
    with pytest.raises(WorldError, match="10,000 pieces together"):
        World(movers=(long, long))
    with pytest.raises(WorldError, match=r"movers: .* must be of Mover"):
        World(movers=["Ann"])  # type: ignore[list-item]

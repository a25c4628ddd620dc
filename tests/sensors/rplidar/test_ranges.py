"""What an RPLIDAR measures, direction by direction, turn by turn."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
from lds2d.drivers import rplidar as library
from lidar_tools import Floats, nothing, room, turns
from rplidar_tools import (
    MAX,
    MILLIMETRES,
    Open,
    Start,
    directions,
    measure,
    newer,
    reset,
    shows_the_room,
)
from serial_tools import Emulated

from acsar_gym.config import LidarConfig
from acsar_gym.sensors.lidar import bin_ranges
from acsar_gym.sensors.rplidar import TurnDecoder
from acsar_gym.tools.emulation.rplidar import RplidarTwin

pytestmark = pytest.mark.usefixtures("deadline")


@pytest.mark.parametrize(
    ("rays", "degrees"), [(1, 360), (5, 360), (64, 360), (180, 360), (2, 270), (91, 270)]
)
def test_every_direction_of_a_field_has_its_own_wall(
    sensor: Emulated, make: Open, rays: int, degrees: float
) -> None:
    field = math.radians(degrees)
    ranges = measure(make(sensor, rays=rays, field_of_view=field))
    assert ranges.shape == (rays,)
    assert shows_the_room(ranges, field)
    assert rays in (1, 5) or not shows_the_room(ranges[::-1], field)


@pytest.mark.parametrize("field", [270.0, 360.0])
def test_directions_finer_than_the_sensors_have_no_gaps(
    sensor: Emulated, make: Open, field: float
) -> None:
    field = math.radians(field)
    angles = directions(1500, field)
    ranges = measure(make(sensor, rays=1500, field_of_view=field))
    near = np.stack([room(angles + off) for off in np.radians(np.linspace(-0.6, 0.6, 25))])
    assert (ranges >= near.min(axis=0) - MILLIMETRES).all()
    assert (ranges <= near.max(axis=0) + MILLIMETRES).all()


def test_ranges_are_clamped(sensor: Emulated, make: Open) -> None:
    ranges = measure(make(sensor, rays=360, min_range=1.0, max_range=2.0))
    expected = np.clip(room(directions(360)), 1.0, 2.0)
    assert np.abs(ranges - expected).max() < MILLIMETRES


def measured(degrees: list[float], distances: list[float], **lidar: float) -> list[float]:
    """The ranges of a turn that measured this, and missed in a hundred other directions."""
    bearings, missed = np.radians([*degrees, *range(100)]), [0.0] * 100
    config = LidarConfig(**{"rays": 4, "max_range": MAX, **lidar})
    found: list[float] = bin_ranges(bearings, np.array([*distances, *missed]), config).tolist()
    return found


def test_the_measurement_next_to_a_direction_counts_and_zero_is_none() -> None:
    assert measured([1.0, 10.0, 350.0, 90.0], [3.0, 2.0, 2.0, 0.0]) == [MAX, MAX, 3.0, MAX]
    assert measured([-178.0, 170.0, 91.0], [3.0, 2.0, 4.0]) == [3.0, MAX, MAX, 4.0]
    assert measured([], []) == [MAX] * 4
    one = {"rays": 1, "field_of_view": math.radians(90.0)}  # the first of its field
    assert measured([-45.0, 60.0], [2.0, 1.0], **one) == [2.0]
    assert measured([-30.0, 60.0], [2.0, 1.0], **one) == [MAX]


def test_only_neighbours_within_the_sensors_step_fill_a_gap() -> None:
    angles = list(np.arange(0.0, 360.0, 2.0))  # even directions measure, odd ones don't
    distances = [1.0 if angle < 100.0 else 0.0 for angle in angles]
    lidar = LidarConfig(rays=360)
    ranges = bin_ranges(np.radians(angles), np.array(distances), lidar).tolist()
    assert ranges[179:280] == [1.0] * 101
    assert ranges[280:] + ranges[:179] == [MAX] * 259


def stream(look: Callable[[Floats], Floats] = room, samples: int = 100) -> bytes:
    """Half a turn, and three whole ones."""
    twin = RplidarTwin(look, rate=1.0, samples=samples)
    twin.advance(0.5)
    twin.receive(b"\xa5\x20")
    return twin.advance(3.6)


@pytest.mark.parametrize("size", [1, 3, 5, 64, 10_000])
def test_turns_are_complete_whatever_the_pieces(size: int) -> None:
    data = stream()
    decoder = TurnDecoder(library)
    found = [
        turn for at in range(0, len(data), size) for turn in decoder.feed(data[at : at + size])
    ]
    assert [len(bearings) for bearings, _ in found] == [100, 100, 100]
    for bearings, distances in found:
        assert np.abs(distances - room(bearings)).max() < MILLIMETRES


@pytest.mark.parametrize("look", [room, nothing])
def test_a_turn_that_lost_bytes_is_dropped(look: Callable[[Floats], Floats]) -> None:
    data = stream(look)
    whole = TurnDecoder(library).feed(data)
    for at in range(250, 760):  # in the first whole turn, or just behind it
        found = TurnDecoder(library).feed(data[:at] + data[at + 1 :])
        assert 1 <= len(found) < 3
        for bearings, distances in found:
            assert len(bearings) == 100
            assert any(np.array_equal(distances, other) for _, other in whole)


def test_turns_with_holes_and_streams_without_turns_are_dropped() -> None:
    data = stream()
    assert len(TurnDecoder(library).feed(data[:400] + data[500:])) == 2
    assert len(TurnDecoder(library).feed(stream(samples=20))) == 0
    decoder = TurnDecoder(library)
    for _ in range(3):
        assert not decoder.feed(b"\x3d\x01\x00\x00\x00" + 20_000 * b"\x3e\x01\x00\x00\x00")


def test_a_turn_is_stamped_when_it_is_complete(start: Start, make: Open) -> None:
    emulated = start("--rate", "5.5")
    lidar = make(emulated)
    reset(lidar)
    stamps = [lidar.scan().stamp]
    for _ in range(7):
        stamps.append(newer(lidar, stamps[-1]).stamp)
    assert time.monotonic() >= stamps[-1]
    ends = np.array(turns(emulated))
    lags = [stamp - ends[ends <= stamp].max() for stamp in stamps]
    assert statistics.median(lags) < 0.5 / 5.5  # were it the turn before, a whole turn


def test_an_open_one_resets_at_once_and_scans_are_the_callers_own(
    sensor: Emulated, make: Open
) -> None:
    lidar = make(sensor)
    reset(lidar)
    scans = [lidar.scan() for _ in range(100)]
    assert len({scan.stamp for scan in scans}) < 100  # it doesn't wait for the next turn
    scans[0].ranges[:] = 0.0
    assert scans[1].ranges.min() > 0.5
    before, states = lidar.scan().stamp, len([e for e in sensor.events() if "pwm" in e])
    for _ in range(100):
        reset(lidar)
    assert lidar.scan().stamp >= before
    newer(lidar, time.monotonic())
    assert len([e for e in sensor.events() if "pwm" in e]) == states

"""The sensor of what moves: its numbers. `test_map` compares a batch and a single env."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.sensors.map.movers import (
    FIRST_COURSE,
    MOST_MOVERS,
    MOST_RADIUS,
    MOST_SPEED,
    MOVER_LOW,
    MOVER_NAMES,
    fill_alone,
)
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MapSensor, log_share
from acsar_gym.sensors.map.tracks import AGE, HAS_MOVED, MOVES, RADIUS, SPEED_VAR

ACSAR = RobotConfig.preset("acsar")


def observe(
    *tracks: tuple[float, ...], pose: Any = (0.0, 0.0, 0.0), moves: float = 1.0
) -> tuple[Any, Any]:
    """Numbers of the sensor for tracks of place, velocity and radius.

    Returns:
        (MOST_MOVERS, NUMBERS): of the tracks, and (2, COURSES): contacts and gaps of the courses.
    """
    record: Any = MapSensor(None, ACSAR).records
    for row, numbers in zip(record["tracks"][0], tracks, strict=False):
        row[: RADIUS + 1] = numbers
        row[[AGE, MOVES, HAS_MOVED, SPEED_VAR]] = 5.0, moves, moves, 0.04
    out = np.full(len(MOVER_NAMES), np.nan)
    fill_alone(record, pose, out)
    assert (out >= MOVER_LOW).all()
    assert (out <= 1.0).all()
    return out[:FIRST_COURSE].reshape(MOST_MOVERS, -1), out[FIRST_COURSE:].reshape(2, -1)


def test_movers_are_in_the_robots_frame_and_units_the_first_to_be_met_first() -> None:
    beside = (0.0, 2.0, -0.4, 0.0, 0.2)
    ahead = (1.0, 4.0, 0.0, -0.6, 0.3)
    rows, _ = observe(beside, ahead, pose=(1.0, 2.0, math.pi / 2.0))
    scale = MOST_SPEED * ACSAR.max_linear
    radius = outline_radius(ACSAR.outline)
    near, distant = (log_share(length / radius, FARTHEST_CLEARANCE) for length in (1.0, 2.0))
    narrow, wide = (size / radius / MOST_RADIUS for size in (0.2, 0.3))
    assert rows[0] == pytest.approx([0.5, distant, 0, -0.6 / scale, 0, wide, 1, 0.2])
    assert rows[1] == pytest.approx([0.5, 0, near, 0, 0.4 / scale, narrow, 1, 0.2])
    assert not rows[2:].any()


def test_movers_are_the_first_of_many_and_clipped() -> None:
    many = [(6.0 + 0.3 * n, 0.1, 9.0, -9.0, 5.0) for n in range(MOST_MOVERS + 3)]
    rows, _ = observe(*many[::-1])
    assert (rows[:, 0] == 0.5).all()
    assert (np.diff(rows[:, 1]) > 0.0).all()
    assert rows[0, 3:].tolist() == pytest.approx([1.0, -1.0, 1.0, 1.0, 0.2])
    nothing, courses = observe()
    assert not nothing.any()
    assert (courses == 1.0).all()


@pytest.mark.parametrize(
    ("speed", "moves", "is_met"), [(0.9, 0.0, True), (0.25, 0.0, False), (0.25, 1.0, True)]
)
def test_movers_that_are_unsure_are_met_on_courses(
    speed: float, moves: float, is_met: bool
) -> None:
    _, courses = observe((1.5, 0.0, -speed, 0.0, 0.2), moves=moves)
    assert courses.min() < 0.5 if is_met else (courses == 1.0).all()

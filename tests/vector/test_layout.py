"""Blocks of robots: what is declared, and where its numbers are."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from acsar_gym.physics import Physics
from acsar_gym.tasks.state import INFO
from acsar_gym.vector.kernel import layout

ROBOTS = 100
"""More than a block, and not whole blocks."""


def test_fields_are_read_in_the_order_of_robots() -> None:
    blocks = layout.make_blocks(ROBOTS)
    numbers = layout.view_numbers(blocks)
    for robot in range(ROBOTS):
        block, i = divmod(robot, layout.BLOCK_ROBOTS)
        blocks["goal_x"][block, i] = robot
        blocks["wheel_speed"][block, :, i] = [robot + wheel / 10 for wheel in range(4)]
    each = np.arange(float(ROBOTS))
    names = ("wheel_speed", "goal_x")
    expected = np.array([each, each + 0.1, each + 0.2, each + 0.3, each])
    assert layout.read_fields(numbers, names, slice(ROBOTS)) == pytest.approx(expected)
    some = np.array([70, 3])
    assert layout.read_fields(numbers, names, some) == pytest.approx(expected[:, some])


def test_a_robots_physics_is_written_number_by_number() -> None:
    blocks = layout.make_blocks(1)
    rows = layout.view_numbers(blocks)[0, layout.PHYSICS_ROW : layout.BUILD_ROW]
    rows[:, 5] = range(len(Physics._fields))
    own = blocks["physics"][0]
    for k, name in enumerate(Physics._fields):
        stem, _, wheel = name.rpartition("_")
        values = own[stem]["abcd".index(wheel)] if wheel in tuple("abcd") else own[name]
        assert values[5] == k


def test_an_episodes_numbers_come_first_and_options_are_not_among_them() -> None:
    began = {name for name, rows in layout.ROWS.items() if rows.stop <= layout.EPISODE_ROWS}
    assert began == set(inspect.get_annotations(layout.Episode))
    assert not began & set(layout.OPTIONS)
    assert set(INFO.values()) <= began

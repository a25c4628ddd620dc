"""Paths to follow, against ones that are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.worlds.search import (
    drop_repeated,
    path_length,
    sample_path,
    world_along,
)


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


CORNER = array([0, 0], [1, 0], [1, 0], [1, 0.5])


def test_samples_by_hand() -> None:
    found = sample_path(CORNER, 0.25)
    assert found[:, :2].tolist() == [
        [0.0, 0.0],
        [0.25, 0.0],
        [0.5, 0.0],
        [0.75, 0.0],
        [1.0, 0.0],
        [1.0, 0.25],
        [1.0, 0.5],
    ]
    up = math.pi / 2.0
    assert found[:, 2].tolist() == [0.0, 0.0, 0.0, 0.0, up, up, up]  # at the corner, the way on


@pytest.mark.parametrize(
    ("path", "theta"),
    [
        (array([1, 2], [3, 2]), 0.0),
        (array([1, 2], [1, 2], [1, 5], [9, 9]), math.pi / 2.0),
        (array([1, 2], [0, 1], [1, 2]), -3.0 * math.pi / 4.0),
    ],
)
def test_along_a_path_the_robot_starts_on_it(path: Any, theta: float) -> None:
    world = world_along(path)
    assert world.obstacles == 0
    assert (world.start.x, world.start.y, world.start.radius) == (1.0, 2.0, 0.0)
    assert world.start.theta == pytest.approx(theta)
    assert (world.goal.x, world.goal.y) == tuple(path[-1])
    assert world.path is not None
    assert world.path.tolist() == drop_repeated(path).tolist()
    assert world.length == pytest.approx(path_length(path))
    assert not world.path.flags.writeable

"""The world's frame and the odometry frame, which begins at a scene's start."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.worlds.world import point_in_world, to_odometry, to_world

poses = st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.floats(-math.pi, math.pi))


@given(start=poses, pose=poses)
def test_there_and_back_is_the_same_pose(start: tuple[float, float, float], pose: object) -> None:
    assert isinstance(pose, tuple)
    x, y, theta = to_odometry(start, to_world(start, pose))
    assert (x, y) == pytest.approx(pose[:2], abs=1e-9)
    assert math.remainder(theta - pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


def test_odometry_begins_at_the_start() -> None:
    start = (3.0, 2.0, math.pi / 2.0)  # looking along +y
    assert to_odometry(start, start) == (0.0, 0.0, 0.0)
    assert to_odometry(start, (3.0, 4.0, -3.0)) == pytest.approx(
        (2.0, 0.0, 1.5 * math.pi - 3.0), abs=1e-12
    )
    assert point_in_world(start, (2.0, 1.0)) == pytest.approx((2.0, 4.0))


def test_from_the_origin_nothing_changes() -> None:
    origin, pose = (0.0, 0.0, 0.0), (1.25, -2.5, 3.0)
    assert to_odometry(origin, pose) == to_world(origin, pose) == pose

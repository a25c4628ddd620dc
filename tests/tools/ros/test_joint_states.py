"""The joint states of a late tick, without ROS."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym.protocol import Speeds
from acsar_gym.tools.ros.driver import list_earlier

ANGLES: Speeds = (1.0, 2.0, 3.0, 4.0)


def test_a_tick_in_time_has_one_joint_state() -> None:
    assert list_earlier([((1.0, 1.0, 1.0, 1.0), 0.01)], 5_000_000_000, ANGLES) == []
    assert list_earlier([], 5_000_000_000, ANGLES) == []


def test_joint_states_tell_all_that_odometry_integrated_in_a_late_tick() -> None:
    """Whose readers hold each speed from the stamp before it to its own."""
    shares: list[tuple[Speeds, float]] = [
        ((1.0, 2.0, 2.0, 1.0), 0.008),
        ((3.0, 4.0, 4.0, 3.0), 0.008),
        ((5.0, 6.0, 6.0, 5.0), 0.008),
    ]
    end = 5_000_000_000
    first, second = list_earlier(shares, end, ANGLES)
    assert (first[0], second[0]) == (end - 16_000_000, end - 8_000_000)
    assert (first[1], second[1]) == (shares[0][0], shares[1][0])
    turned = np.array(shares[2][0]) * 0.008
    assert second[2] == pytest.approx(np.array(ANGLES) - turned)
    assert first[2] == pytest.approx(np.array(second[2]) - np.array(shares[1][0]) * 0.008)

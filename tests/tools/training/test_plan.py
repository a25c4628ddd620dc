"""How many threads a training takes."""

from __future__ import annotations

import pytest

from acsar_gym.tools.training import plan
from acsar_gym.vector.env import usable_cores


@pytest.mark.parametrize(
    ("cores", "share", "free"),
    [
        (2, 1.0, 2),
        (2, 0.95, 2),
        (2, 2 / 3, 1),  # one busy program beside two threads
        (2, 0.5, 1),
        (2, 0.0, 1),
        (8, 8 / 11, 5),
        (8, 1.01, 8),
    ],
)
def test_threads_that_would_share_a_core_are_left_out(cores: int, share: float, free: int) -> None:
    assert plan.compute_free_cores(cores, share) == free


def test_the_measurement_is_within_what_there_is() -> None:
    assert 1 <= plan.measure_free_cores() <= usable_cores()

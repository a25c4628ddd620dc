"""How many threads a training takes."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training import plan
from acsar_gym.vector.env import choose_threads, usable_cores


def batch(asked: int) -> int:
    """The threads of a batch."""
    return choose_threads(asked, 1024)


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


def test_a_number_that_is_given_is_taken() -> None:
    assert plan.choose_threads(1) == 1


@pytest.mark.parametrize("asked", [0, -1, 4096])
def test_impossible_numbers_are_refused(asked: int) -> None:
    with pytest.raises(ConfigError, match=f"--threads {asked}: must be 1"):
        plan.choose_threads(asked)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="there are no affinities here")
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="there is one core")
@pytest.mark.parametrize(
    ("name", "choose"), [("--threads", plan.choose_threads), ("threads =", batch)]
)
def test_a_process_held_to_one_core_is_told_so(name: str, choose: Callable[[int], int]) -> None:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        with pytest.raises(ConfigError) as error:
            choose(99)
    finally:
        os.sched_setaffinity(0, before)
    assert str(error.value) == (
        f"{name} 99: must be 1, the cores that this process may use: taskset, a batch system or a "
        f"container keeps it from the others of this machine's {os.cpu_count()}"
    )

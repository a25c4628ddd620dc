"""Levels of domain randomization."""

from __future__ import annotations

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics import Randomization
from acsar_gym.physics.randomization import randomization_level

ACSAR = RobotConfig.of(None)


def test_the_second_level_is_that_of_training() -> None:
    assert randomization_level(ACSAR, 2) == Randomization.measured(ACSAR)


def test_levels_are_nested() -> None:
    narrow, usual, wide = (randomization_level(ACSAR, number) for number in (1, 2, 3))
    for name in usual.names:
        ends = [getattr(each, name) for each in (narrow, usual, wide)]
        assert ends[2][0] <= ends[1][0] <= ends[0][0] <= ends[0][1] < ends[1][1] < ends[2][1]
    assert wide.latency == (0.0, 0.04)
    assert wide.friction == pytest.approx((0.4, 1.4))


@pytest.mark.parametrize("number", [1, 2, 3])
def test_every_level_suits_a_robot_that_hardly_skids(number: int) -> None:
    robot = ACSAR.with_(body={"turn_factor": 1.02})
    randomization_level(robot, number).ranges(robot, 0.1)


def test_there_are_three() -> None:
    with pytest.raises(ConfigError, match="must be 1, 2 or 3"):
        randomization_level(ACSAR, 4)

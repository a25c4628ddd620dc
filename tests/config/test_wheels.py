"""The wiring of the wheels: read, checked, saved, and applied at both ends of the wire."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.config import WheelsConfig
from acsar_gym.errors import ConfigError
from acsar_gym.protocol import Decoder, Speeds
from acsar_gym.recording.types import WireLog

MIXED = {
    "a": {"motor": "b", "encoder": "c", "sign": -1},
    "b": {"motor": "a", "motor_sign": -1, "encoder": "d"},
    "c": {"motor": "d", "encoder": "a"},
    "d": {"motor": "c", "encoder": "b", "motor_sign": -1, "sign": -1},
}
"""Letters and signs of both directions differ."""
WIRINGS = [
    {"b": {"sign": -1}},
    {"a": {"motor_sign": -1, "sign": -1}},
    {"a": {"encoder": "b"}, "b": {"encoder": "a"}},
    {"a": {"motor": "b"}, "b": {"motor": "a"}, "c": {"motor": "d"}, "d": {"motor": "c"}},
    MIXED,
]


def test_missing_letters_are_the_wheels_own() -> None:
    wheels = RobotConfig(wheels={"b": {"sign": -1}}).wheels
    assert [(wheel.motor, wheel.encoder) for wheel in wheels.each] == [(x, x) for x in "abcd"]
    assert [wheel.sign for wheel in wheels.each] == [1, -1, 1, 1]


def test_the_usual_wiring_maps_nothing() -> None:
    assert (WheelsConfig().motors, WheelsConfig().encoders) == (None, None)


@pytest.mark.parametrize(
    ("wheels", "said"),
    [
        ({"a": {"motor": "e"}}, "wheels.a.motor = 'e': must be 'a', 'b', 'c' or 'd'"),
        ({"c": {"sign": 0}}, "wheels.c.sign = 0: must be 1 or -1"),
        ({"b": {"encoder": "a"}}, "encoder a belongs to 2 wheels"),
        ({"b": {"motor": "d"}}, "motor d belongs to 2 wheels"),
        ({"e": {}}, "unknown field 'wheels.e'"),
        ({"a": {"motr": "a"}}, "wheels.a.motr"),
        ({"a": 5}, "wheels.a = 5"),
    ],
)
def test_bad_wirings_are_one_error(wheels: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RobotConfig(wheels=wheels)
    assert said in str(caught.value)


@pytest.mark.parametrize("wheels", WIRINGS)
def test_it_is_saved_and_read_back(wheels: dict[str, Any], tmp_path: Path) -> None:
    config = RobotConfig(wheels=wheels)
    config.save(tmp_path / "robot.yaml")
    assert RobotConfig.load(tmp_path / "robot.yaml") == config


def test_letters_there_and_back() -> None:
    letters = WheelsConfig(**MIXED).encoders
    assert letters is not None
    speeds = (1.0, -2.0, 0.0, 4.0)
    assert letters.to_wire(speeds) == (0.0, -4.0, -1.0, -2.0)
    assert letters.to_wheels(letters.to_wire(speeds)) == speeds
    assert letters.to_wheels((None, 4.0, None, None)) == (None, None, None, -4.0)


def driven(config: RobotConfig) -> tuple[list[Speeds], tuple[float, float, float]]:
    """Wheel speeds and true pose of a robot that drives an arc."""
    with Robot(open_link("planar", config), config) as robot:
        speeds = []
        for _ in range(100):
            robot.drive(0.3, 0.5)
            speeds.append(robot.speeds)
        assert robot.link.truth is not None
        return speeds, robot.link.truth.pose


@pytest.mark.parametrize("wheels", WIRINGS)
def test_board_and_driver_agree_with_any_wiring(wheels: dict[str, Any]) -> None:
    assert driven(RobotConfig(wheels=wheels)) == driven(RobotConfig())


def test_a_log_is_decoded_into_wheels() -> None:
    config = RobotConfig(wheels=MIXED)
    line = b"ap01.00,bp02.00,cp03.00,dp04.00,\r\n"
    log = WireLog(np.zeros(1), (line,), np.zeros(1), (line,))
    assert log.commands(config)[1].tolist() == [[2.0, -1.0, 4.0, -3.0]]
    assert log.feedback(config)[1].tolist() == [[-3.0, 4.0, 1.0, -2.0]]
    assert Decoder().feed(line)[0].speeds == (1.0, 2.0, 3.0, 4.0)


def test_every_permutation_is_a_wiring() -> None:
    for order in itertools.permutations("abcd"):
        wheels = {x: {"motor": y, "encoder": y} for x, y in zip("abcd", order, strict=True)}
        letters = RobotConfig(wheels=wheels).wheels.motors
        assert (letters is None) == (order == tuple("abcd"))

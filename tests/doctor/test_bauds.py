"""Baud rates that a robot's file doesn't say."""

from __future__ import annotations

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import BoardGarbledError, ConfigError
from acsar_gym.tools.doctor import wire

CONFIG = RobotConfig.preset("acsar")


@pytest.mark.parametrize(("baud", "rate"), [(9600, 20.0), (19200, 50.0), (38400, 100.0)])
def test_a_slow_line_lowers_the_control_rate(baud: int, rate: float) -> None:
    robot = wire.at_baud_rate(CONFIG, baud)
    assert (robot.baud_rate, robot.control_rate) == (baud, rate)


@pytest.mark.parametrize("baud", [57601, 12345])
def test_rates_that_no_board_uses_are_named(baud: int) -> None:
    with pytest.raises(ConfigError, match="must be one of 9600"):
        wire.at_baud_rate(CONFIG, baud)


def test_a_line_that_is_too_slow_for_the_feedback_is_refused() -> None:
    with pytest.raises(ConfigError, match="baud_rate = 9600"):
        wire.at_baud_rate(CONFIG.with_(firmware={"feedback_rate": 50.0}), 9600)


def test_a_board_of_another_language(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    class Garbled:
        def __init__(self, device: str, config: RobotConfig) -> None:
            tried.append(config.baud_rate)

        def open(self) -> None:
            raise BoardGarbledError("no valid line")

        def close(self) -> None:
            pass

    monkeypatch.setattr(wire, "SerialLink", Garbled)
    check = wire.search_baud_rate("/dev/ttyUSB0", CONFIG)
    assert check.status == "fail"
    assert tried == [57600, 38400, 19200, 9600]

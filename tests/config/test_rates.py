"""Rates: what fits the wire, and which are whole multiples of others."""

from __future__ import annotations

from typing import Any

import pytest
from config_tools import config_of, refusal

from acsar_gym import RobotConfig
from acsar_gym.config import whole_ratio
from acsar_gym.errors import ConfigError

LINES_PER_SECOND = [(9600, 28), (19200, 56), (38400, 112), (57600, 169), (115200, 338)]


@pytest.mark.parametrize(("baud", "lines"), LINES_PER_SECOND)
def test_commands_must_fit_the_baud_rate(baud: int, lines: int) -> None:
    config = config_of(baud_rate=baud, control_rate=lines, firmware={"loop_rate": lines})
    assert config.control_rate == lines
    too_fast = {"baud_rate": baud, "control_rate": lines + 1, "firmware": {"loop_rate": lines + 1}}
    message = refusal(RobotConfig, too_fast)
    assert message.startswith(f"baud_rate = {baud}: carries {lines} lines of 34 bytes a second")
    assert f"control_rate needs {lines + 1}" in message


@pytest.mark.parametrize(("baud", "rate"), [(9600, 25), (19200, 50), (38400, 100)])
def test_the_rate_that_is_suggested_works(baud: int, rate: int) -> None:
    message = refusal(RobotConfig, {"baud_rate": baud, "control_rate": 200})
    assert message.endswith(f"control_rate = {rate} or less")
    assert config_of(baud_rate=baud, control_rate=rate).control_rate == rate


@pytest.mark.parametrize(("baud", "lines"), LINES_PER_SECOND)
def test_feedback_must_fit_the_baud_rate(baud: int, lines: int) -> None:
    def at(rate: int) -> dict[str, Any]:
        firmware = {"loop_rate": rate, "feedback_rate": rate}
        return {"baud_rate": baud, "control_rate": 1, "firmware": firmware}

    assert config_of(**at(lines)).feedback_rate == lines
    message = refusal(RobotConfig, at(lines + 1))
    assert message.startswith(f"baud_rate = {baud}: carries {lines} lines")
    assert f"firmware.feedback_rate needs {lines + 1}" in message


@pytest.mark.parametrize(
    ("rate", "baud", "enough"), [(40, 9600, 19200), (100, 9600, 38400), (200, 19200, 115200)]
)
def test_a_slow_wire_names_the_first_baud_rate_that_is_fast_enough(
    rate: int, baud: int, enough: int
) -> None:
    message = refusal(RobotConfig, {"control_rate": rate, "baud_rate": baud})
    assert f"use baud_rate {enough} or more" in message
    assert config_of(control_rate=rate, baud_rate=enough).baud_rate == enough


def test_no_baud_rate_is_suggested_where_none_is_fast_enough() -> None:
    message = refusal(RobotConfig, {"control_rate": 400, "firmware": {"loop_rate": 400}})
    assert "use control_rate = 200 or less" in message
    assert "or more" not in message


def test_the_trailing_comma_takes_its_time_on_the_wire() -> None:
    values: dict[str, Any] = {"control_rate": 345, "firmware": {"loop_rate": 345}}
    assert config_of(**values, trailing_comma=False).control_rate == 345
    assert "34 bytes" in refusal(RobotConfig, values)


@pytest.mark.parametrize(
    ("values", "slow", "rate"),
    [
        ({"control_rate": 30}, "control_rate", "30"),
        ({"control_rate": 300, "firmware": {"loop_rate": 200}}, "control_rate", "300"),
    ],
)
def test_the_firmware_loop_is_a_whole_multiple_of_the_control_rate(
    values: dict[str, Any], slow: str, rate: str
) -> None:
    message = refusal(RobotConfig, values)
    assert message.startswith("firmware.loop_rate = ")
    assert f"must be a whole multiple of {slow} = {rate} Hz" in message


def test_boards_may_send_at_any_rate_up_to_their_loop() -> None:
    assert config_of(firmware={"feedback_rate": 30}).feedback_rate == 30
    too_fast = {"firmware": {"loop_rate": 100, "feedback_rate": 200}}
    assert "at most firmware.loop_rate = 100 Hz" in refusal(RobotConfig, too_fast)


def test_feedback_must_not_be_given_up_between_two_lines() -> None:
    slow = {"firmware": {"feedback_rate": 2}}
    assert "one and a half periods" in refusal(RobotConfig, slow)
    assert config_of(**slow, feedback_timeout=1.0).feedback_rate == 2


@pytest.mark.parametrize(
    ("fast", "slow", "whole"), [(100, 10, 10), (100, 100, 1), (0.3, 0.1, 3), (1 / 3, 1 / 9, 3)]
)
def test_whole_ratio(fast: float, slow: float, whole: int) -> None:
    assert whole_ratio("fast", fast, "slow", slow) == whole


@pytest.mark.parametrize(("fast", "slow"), [(10, 100), (100, 30), (1, 3), (100, 99.99), (1, 10)])
def test_a_ratio_that_is_not_whole_names_both_rates(fast: float, slow: float) -> None:
    with pytest.raises(ConfigError, match=rf"quick = {fast:g} Hz.*multiple of lazy = {slow:g} Hz"):
        whole_ratio("quick", fast, "lazy", slow)


def test_the_encoder_window_is_at_least_a_period_of_the_loop() -> None:
    assert config_of(encoder={"window": 0.005}).encoder.window == 0.005
    message = refusal(RobotConfig, {"encoder": {"window": 0.004}})
    assert message.startswith("encoder.window = 0.004 s: ")
    assert "firmware.loop_rate (0.005 s)" in message

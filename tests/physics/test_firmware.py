"""The microcontroller's twin: bytes in, bytes out."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.physics.firmware import Firmware
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import ZERO, Decoder, Speeds, encode
from acsar_gym.worlds import Scene

TICK = 0.01
FORWARD: Speeds = (8.0, 8.0, 8.0, 8.0)


def board(**options: Any) -> tuple[Firmware, PlanarBody]:
    config = RobotConfig(**options)
    body = PlanarBody(config)
    return Firmware(config, body), body


def speeds_of(answer: bytes) -> list[tuple[float | None, ...]]:
    return [reading.speeds for reading in Decoder().feed(answer)]


def drive(firmware: Firmware, line: bytes, ticks: int) -> bytes:
    answer = b""
    for _ in range(ticks):
        firmware.receive(line)
        answer += firmware.advance(TICK)
    return answer


@pytest.mark.parametrize("rate", [10.0, 100.0])
def test_feedback_comes_unasked_and_has_the_speed_that_was_commanded(rate: float) -> None:
    firmware, _ = board(firmware={"feedback_rate": rate})
    answer = b"".join(firmware.advance(TICK) for _ in range(100))
    assert abs(answer.count(b"\r\n") - rate) <= 2.0
    assert set(speeds_of(answer)) == {ZERO}
    last = speeds_of(drive(firmware, encode((5.0, -4.0, 3.0, -2.0)), 200))[-1]
    assert last == pytest.approx((5.0, -4.0, 3.0, -2.0), abs=0.1)


@pytest.mark.parametrize(("delay", "motion"), [(0.0, 6), (0.0012, 7), (0.0373, 43)])
def test_command_delay_is_exact_to_the_loop(delay: float, motion: int) -> None:
    """The line takes 2.95 ms and its processing 1.25 ms. A loop period is 1 ms."""
    firmware, body = board(firmware={"loop_rate": 1000.0, "command_delay": delay})
    firmware.receive(encode(FORWARD))
    loops = 0
    while body.wheel_speeds == ZERO:
        firmware.advance(0.001)
        loops += 1
    assert loops == motion


@pytest.mark.parametrize("quantum", [0.025, 1.0])
def test_quantum_divides_the_speeds_that_are_printed(quantum: float) -> None:
    firmware, body = board(encoder={"quantum": quantum, "window": 0.2})
    answer = speeds_of(drive(firmware, encode((5.03, -4.77, 0.4, 0.0)), 100))
    for speed in (speed for speeds in answer for speed in speeds):
        assert speed is not None
        assert abs(speed / quantum - round(speed / quantum)) <= 0.0051 / quantum
    assert answer[-1] == pytest.approx(body.wheel_speeds, abs=quantum / 2 + 0.03)


@pytest.mark.parametrize("line", [b"", b"xp99.99,ap9.9\r\n"])
def test_motors_stop_without_valid_commands(line: bytes) -> None:
    firmware, body = board(firmware={"command_timeout": 0.3})
    drive(firmware, encode(FORWARD), 100)
    drive(firmware, line, 29)
    assert body.wheel_speeds[0] == pytest.approx(8.0)
    drive(firmware, line, 200)
    assert body.wheel_speeds == ZERO
    assert firmware.decoder.refused["unknown motor"] == (229 if line else 0)


def test_reset_forgets_everything() -> None:
    firmware, body = board()
    fresh = drive(firmware, encode(FORWARD), 50)
    firmware.receive(b"half a li")
    body.reset(Scene())
    firmware.reset()
    assert drive(firmware, encode(FORWARD), 50) == fresh

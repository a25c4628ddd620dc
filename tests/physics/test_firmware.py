"""The microcontroller's twin: bytes in, bytes out."""

from __future__ import annotations

import math

import pytest

from acsar_gym.config import BodyConfig, EncoderConfig, FirmwareConfig, MotorConfig, RobotConfig
from acsar_gym.physics.firmware import Firmware
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import ZERO, Decoder, Speeds, encode

TICK = 0.01
FORWARD: Speeds = (8.0, 8.0, 8.0, 8.0)


def board(config: RobotConfig | None = None) -> tuple[Firmware, PlanarBody]:
    config = config or RobotConfig()
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


def test_it_speaks_unasked_and_reports_the_speed_it_was_told() -> None:
    firmware, _ = board()
    answer = b"".join(firmware.advance(TICK) for _ in range(100))
    assert 98 <= answer.count(b"\r\n") <= 100
    assert set(speeds_of(answer)) == {ZERO}
    last = speeds_of(drive(firmware, encode((5.0, -4.0, 3.0, -2.0)), 200))[-1]
    assert last == pytest.approx((5.0, -4.0, 3.0, -2.0), abs=0.1)


@pytest.mark.parametrize("rate", [10.0, 20.0, 30.0, 50.0, 100.0])
def test_feedback_comes_at_its_own_rate(rate: float) -> None:
    firmware, _ = board(RobotConfig(firmware=FirmwareConfig(feedback_rate=rate)))
    answer = b"".join(firmware.advance(TICK) for _ in range(1000))
    assert abs(answer.count(b"\r\n") - 10.0 * rate) <= 1.0


@pytest.mark.parametrize(("delay", "motion"), [(0.0, 0.006), (0.0012, 0.007), (0.0373, 0.043)])
def test_a_command_delay_is_told_to_the_loop(delay: float, motion: float) -> None:
    """The line takes 2.95 ms and its processing 1.25 ms; a loop period is 1 ms."""
    config = RobotConfig(firmware=FirmwareConfig(loop_rate=1000.0, command_delay=delay))
    firmware, body = board(config)
    firmware.receive(encode(FORWARD))
    while body.wheel_speeds == ZERO:
        firmware.advance(0.001)
    assert firmware._elapsed == pytest.approx(motion)


def test_every_wheel_has_its_own_motor() -> None:
    motor = MotorConfig(
        gain=(1.0, 0.9, 1.1, 1.0),
        time_constant=(0.0, 0.0, 0.0, 0.2),
        deadband=(0.0, 0.0, 0.0, 0.0),
        acceleration=(10.0, 20.0, 1e6, 1e6),
    )
    firmware, body = board(RobotConfig(motor=motor))
    drive(firmware, encode(FORWARD), 41)  # acts for 0.4 s, in 80 loops
    a, b, c, d = body.wheel_speeds
    assert (a, b, c) == pytest.approx((4.0, 7.2, 8.8), abs=0.06)
    assert d == pytest.approx(8.0 * (1.0 - math.exp(-2.0)), abs=0.05)


@pytest.mark.parametrize("quantum", [0.025, 0.1, 0.25, 1.0])
def test_printed_speeds_are_multiples_of_the_quantum(quantum: float) -> None:
    firmware, body = board(RobotConfig(encoder=EncoderConfig(quantum=quantum, window=0.2)))
    answer = speeds_of(drive(firmware, encode((5.03, -4.77, 0.4, 0.0)), 100))
    for speed in (speed for speeds in answer for speed in speeds):
        assert speed is not None
        assert abs(speed / quantum - round(speed / quantum)) <= 0.0051 / quantum
    last = answer[-1]
    assert last == pytest.approx(body.wheel_speeds, abs=quantum / 2 + 0.03)


def test_motors_stop_when_commands_stop() -> None:
    firmware, body = board(RobotConfig(firmware=FirmwareConfig(command_timeout=0.3)))
    drive(firmware, encode(FORWARD), 100)
    firmware.advance(0.29)
    assert body.wheel_speeds[0] == pytest.approx(8.0)
    firmware.advance(2.0)
    assert body.wheel_speeds == ZERO


def test_garbage_is_no_command_and_keeps_nobody_alive() -> None:
    firmware, body = board(RobotConfig(firmware=FirmwareConfig(command_timeout=0.2)))
    drive(firmware, encode(FORWARD), 100)
    drive(firmware, b"xp99.99,ap9.9\r\n", 300)
    assert body.wheel_speeds == ZERO
    assert firmware.decoder.refused["unknown motor"] == 300


def test_a_reset_forgets_everything() -> None:
    config = RobotConfig(body=BodyConfig(mass=5.0))
    firmware, body = board(config)
    fresh = drive(firmware, encode(FORWARD), 50)
    firmware.receive(b"half a li")
    body.__init__(config)  # type: ignore[misc]
    firmware.reset()
    assert drive(firmware, encode(FORWARD), 50) == fresh

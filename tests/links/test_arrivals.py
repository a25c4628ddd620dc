"""When bytes arrive: to a millisecond on a serial device, exactly in simulation."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest
from serial_tools import TIMEOUT

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording import Recorder, read
from acsar_gym.worlds import Scene

CONFIG = RobotConfig.of(None)


def test_arrivals_in_simulation_are_when_their_last_bit_does() -> None:
    """A line takes 37 bytes of ten bits, after the firmware's processing time."""
    link = open_link("planar", CONFIG)
    link.open()
    link.reset(Scene())
    data = [link.advance(0.01) for _ in range(20)]
    ((stamp, line),) = link.arrivals
    assert line == data[-1]
    sending = CONFIG.firmware.processing_time + len(line) * 10.0 / CONFIG.baud_rate
    assert math.isclose(math.fmod(stamp - sending + 1e-6, 0.01), 1e-6, abs_tol=1e-5)
    assert 0.0 < link.now() - stamp < 0.01
    link.close()


def test_arrivals_of_a_real_drive_are_recorded_and_replays(
    shared_device: str, tmp_path: Path
) -> None:
    path = tmp_path / "tape.mcap"
    patient = CONFIG.with_(watchdog_timeout=TIMEOUT, feedback_timeout=TIMEOUT)
    with Robot(open_link(shared_device, patient), patient, recorder=Recorder(path)) as robot:
        for _ in range(60):
            robot.drive(0.1, 0.0)
        end = robot.wire.stamp
        timing = robot.timing
    with Robot(open_link(f"replay:{path}", patient), patient) as replayed:
        for _ in range(60):
            replayed.drive(0.1, 0.0)
        assert timing is not None
        assert replayed.timing is not None
        assert replayed.timing.round_trips == pytest.approx(timing.round_trips, abs=0.01)

    (episode,) = read(path).episodes
    ends = {round(stamp, 9) for stamp in episode.exchanges["stamp"].tolist()}
    between = [t for t in episode.wire.got_stamps.tolist() if round(t, 9) not in ends]
    assert len(between) > 30  # bytes arrived during the periods, not at their ends
    assert episode.stamps[-1] == end
    assert episode.wire.sent[-1].endswith(encode(ZERO, trailing_comma=CONFIG.trailing_comma))
    wall_clock = episode.offset + round(episode.start * 1e9)
    assert abs(wall_clock - time.time_ns()) < 60e9

"""The manoeuvre of an identification: its limits, its log, and its end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from boards import FailingLink

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.board_log import decode_tracks
from acsar_gym.tools.sysid.excitation import (
    TICK_STRETCH,
    TapedLink,
    drive_excitation,
    plan_excitation,
)

ACSAR = RobotConfig.preset("acsar")
ZEROS = b"ap00.00,bp00.00,cp00.00,dp00.00"


@pytest.mark.parametrize("limits", [{}, {"max_wheel_speed": 3.0}, {"max_linear": 0.1}])
def test_plan_excitation_keeps_the_limits_of_the_robot(limits: dict[str, float]) -> None:
    config = ACSAR.with_(**limits)
    plan = plan_excitation(config, 20.0, 0.01)
    top = min(config.max_wheel_speed, config.max_linear / config.wheel_radius)
    speeds = np.concatenate((plan.first, plan.last))
    assert len(speeds) + plan.pause == pytest.approx(2000, abs=2)
    for fastest in (-speeds.min(axis=0), speeds.max(axis=0)):
        assert ((fastest > 0.5 * top) & (fastest <= top + 1e-9)).all()
    sides = plan_excitation(config, 20.0, 0.01, sides=True)
    assert sides.last.tolist() == plan.last[:, [0, 1, 1, 0]].tolist()


@pytest.mark.usefixtures("deadline")
def test_taped_link_logs_a_serial_wire_finer_than_ticks(
    shared_device: str, config: RobotConfig
) -> None:
    tape = TapedLink(open_link(shared_device, config))
    with Robot(tape, config) as robot:
        for _ in range(60):
            robot.tick((3.0, -3.0, 3.0, -3.0))
        for _ in range(30):
            robot.listen()

    (track,) = decode_tracks([tape.log], config)
    last = np.flatnonzero(track.commands.any(axis=1))[-1]
    assert last in track.pauses
    assert track.commands[last].tolist() == [3.0, -3.0, 3.0, -3.0]
    assert np.median(np.diff(track.arrivals)) == pytest.approx(0.01 * TICK_STRETCH, rel=0.2)
    phases = np.mod(tape.log.got_stamps[:, None] - tape.log.sent_stamps, 0.01)
    assert phases.std() > 1e-3
    assert tape.log.sent[-1].startswith(ZEROS)


class WatchedLink(FailingLink):
    """Remembers what was sent last, and whether it was closed."""

    is_closed = False
    sent = b""

    def write(self, data: bytes) -> None:
        self.sent = data
        super().write(data)

    def close(self) -> None:
        self.is_closed = True
        super().close()


@pytest.mark.parametrize("reason", ["lost", "emergency stop", "geofence"])
def test_drive_excitation_ends_with_zeros(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    link = WatchedLink(open_link("planar", ACSAR), after=3.0 if reason == "lost" else math.inf)
    fence = {"min_x": -0.02, "max_x": 0.02} if reason == "geofence" else None
    tick = Robot.tick

    def stop_late(robot: Robot, speeds: tuple[float, ...]) -> None:
        if reason == "emergency stop" and link.now() > 0.5:
            robot.estop()
        tick(robot, speeds)

    monkeypatch.setattr(Robot, "tick", stop_late)
    with pytest.raises(LinkError, match=reason):
        drive_excitation(link, ACSAR.with_(geofence=fence), 12.0)
    assert link.is_closed
    assert link.sent.startswith(ZEROS)


def test_drive_excitation_refuses_a_duration_out_of_range() -> None:
    with pytest.raises(ConfigError, match="must be 12 to 600 s"):
        drive_excitation(open_link("planar", ACSAR), ACSAR, 5.0)

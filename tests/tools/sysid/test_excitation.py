"""The manoeuvre of an identification: its limits, what it logs, and how it ends."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LinkError
from acsar_gym.links import Link
from acsar_gym.links.base import LinkWrapper
from acsar_gym.recording.recorded import RecordedLink
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.board_log import decode_tracks
from acsar_gym.tools.sysid.excitation import (
    TICK_STRETCH,
    StretchedLink,
    drive_excitation,
    plan_excitation,
)
from acsar_gym.tools.sysid.wire_tape import WireTape

ACSAR = RobotConfig.preset("acsar")
ZEROS = b"ap00.00,bp00.00,cp00.00,dp00.00"


@pytest.mark.parametrize("limits", [{}, {"max_wheel_speed": 3.0}, {"max_linear": 0.1}])
def test_commands_keep_the_limits_of_the_robot(limits: dict[str, float]) -> None:
    config = ACSAR.with_(**limits)
    plan = plan_excitation(config, 20.0, 0.01)
    top = min(config.max_wheel_speed, config.max_linear / config.wheel_radius)
    speeds = np.concatenate((plan.before, plan.after))
    assert np.abs(speeds).max() <= top + 1e-9
    assert len(speeds) + plan.pause == pytest.approx(2000, abs=2)
    assert (speeds.min(0) < -0.5 * top).all()
    assert (speeds.max(0) > 0.5 * top).all()


def test_wheels_of_a_side_can_be_commanded_alike() -> None:
    whole = plan_excitation(ACSAR, 20.0, 0.01)
    sides = plan_excitation(ACSAR, 20.0, 0.01, sides=True)
    for every, two in ((whole.before, sides.before), (whole.after, sides.after)):
        assert two.tolist() == every[:, [0, 1, 1, 0]].tolist()


@pytest.mark.usefixtures("deadline")
def test_a_serial_wire_is_logged_finer_than_ticks(shared_device: str, config: RobotConfig) -> None:
    tape = WireTape()
    link = RecordedLink(StretchedLink(open_link(shared_device, config)), tape, config)
    with Robot(link, config) as robot:
        for _ in range(60):
            robot.tick((3.0, -3.0, 3.0, -3.0))
        for _ in range(30):
            robot.listen()
    (found,) = decode_tracks([tape.log], config)
    last = np.flatnonzero(found.commands.any(axis=1))[-1]
    assert last in found.pauses
    assert found.commands[last].tolist() == [3.0, -3.0, 3.0, -3.0]
    assert np.median(np.diff(found.arrivals)) == pytest.approx(0.01 * TICK_STRETCH, rel=0.2)
    assert len(found.stamps) > 30
    phases = np.mod(tape.log.got_stamps[:, None] - tape.log.sent_stamps, 0.01)
    assert phases.std() > 1e-3
    assert tape.log.sent[-1].startswith(ZEROS)


class FailingLink(LinkWrapper):
    """A link that is lost after three seconds, and remembers what was sent."""

    ticks = 0
    closed = False
    sent = b""

    def __init__(self, link: Link, *, fails: bool) -> None:
        super().__init__(link)
        self._fails = fails

    def write(self, data: bytes) -> None:
        self.sent = data
        super().write(data)

    def advance(self, period: float) -> bytes:
        self.ticks += 1
        if self._fails and self.ticks == 300:
            raise LinkError("lost", "plug it in")
        return super().advance(period)

    def close(self) -> None:
        self.closed = True
        super().close()


def test_a_link_that_is_lost_ends_the_manoeuvre_with_zeros() -> None:
    link = FailingLink(open_link("planar", ACSAR), fails=True)
    with pytest.raises(LinkError, match="lost"):
        drive_excitation(link, ACSAR, 12.0)
    assert link.closed
    assert link.sent.startswith(ZEROS)


@pytest.mark.parametrize("reason", ["emergency stop", "geofence"])
def test_a_stop_ends_the_manoeuvre(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    link, tick = FailingLink(open_link("planar", ACSAR), fails=False), Robot.tick
    fence = {"min_x": -0.02, "max_x": 0.02} if reason == "geofence" else None

    def stop_late(robot: Robot, speeds: tuple[float, ...]) -> None:
        if fence is None and link.ticks > 50:
            robot.estop()
        tick(robot, speeds)

    monkeypatch.setattr(Robot, "tick", stop_late)
    with pytest.raises(LinkError, match=reason):
        drive_excitation(link, ACSAR.with_(geofence=fence), 12.0)
    assert link.sent.startswith(ZEROS)

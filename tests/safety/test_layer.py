"""The safety layer on a simulated robot: what is sent, why, and until when."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import EmergencyStopError
from acsar_gym.links import open_link
from acsar_gym.links.base import LinkWrapper
from acsar_gym.protocol import Decoder
from acsar_gym.safety.rules import Reason
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar").with_(
    linear_limits={"max_acceleration": None}, angular_limits={"max_acceleration": None}
)
STOP = (0.0, 0.0, 0.0, 0.0)
WIRE = 0.002  # largest change of a twist by the two decimals on the wire [m/s, rad/s]


class Tapped(LinkWrapper):
    """A planar link that keeps the newest command, and can fall silent."""

    silent = False

    def write(self, data: bytes) -> None:
        self.last = Decoder().feed(data)[-1].over(STOP)
        self.inner.write(data)

    def advance(self, period: float) -> bytes:
        data = self.inner.advance(period)
        return b"" if self.silent else data


def robot(**fields: Any) -> tuple[Robot, Tapped]:
    """An active robot, and its link."""
    config = ACSAR.with_(**fields)
    link = Tapped(open_link("planar", config))
    driver = Robot(link, config)
    driver.activate()
    return driver, link


@pytest.mark.parametrize(("linear", "angular"), [(-2.0, 0.0), (0.4, -7.0), (1e6, 1e6)])
def test_limits_of_the_full_speeds(linear: float, angular: float) -> None:
    driver, link = robot()
    driver.drive(linear, angular)
    safety = driver.safety
    assert safety.reason is Reason.LIMITS
    assert (np.abs(safety.sent) <= np.add((ACSAR.max_linear, ACSAR.max_angular), 1e-9)).all()
    assert safety.twist(link.last) == pytest.approx(safety.sent, abs=WIRE)


@pytest.mark.parametrize(
    ("fields", "speed", "sent"),
    [
        ({}, 9.9, 9.9),
        ({}, 30.0, 10.0),  # 0.5 m/s at a radius of 0.05 m
        ({"max_wheel_speed": 2.0}, 4.0, 2.0),
        ({"linear_limits": {"min_velocity": 0.0}}, -3.0, 0.0),
    ],
)
def test_bounded_wheel_speeds(fields: dict[str, Any], speed: float, sent: float) -> None:
    driver, link = robot(**fields)
    driver.tick((speed,) * 4)
    assert link.last == pytest.approx((sent,) * 4)
    assert driver.safety.reason is (Reason.NONE if sent == speed else Reason.LIMITS)


def test_acceleration_limits_ramp_commands_but_no_stop() -> None:
    driver, link = robot(linear_limits={"max_acceleration": 1.0})
    speeds = []
    for _ in range(40):
        driver.drive(0.3, 0.0)
        speeds.append(link.last[0])
    assert speeds[:3] == pytest.approx([0.2, 0.4, 0.6])  # 0.01 m/s a tick, radius 0.05 m
    assert speeds[-1] == pytest.approx(6.0)
    assert driver.safety.reason is Reason.NONE
    driver.drive(0.0, 0.0)
    assert link.last == STOP

    driver.tick((6.0, 6.0, 6.0, 6.0))
    driver.drive(0.5, 0.0)
    assert link.last[0] == pytest.approx(6.2)  # ramps from the raw wheel speeds


def test_geofence_stops_until_the_reset() -> None:
    driver, link = robot(geofence={"max_x": 0.2})
    for _ in range(300):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.GEOFENCE
    assert driver.safety.sent == (0.0, 0.0)
    assert 0.2 < driver.odometry.pose[0] < 0.3
    driver.drive(-0.4, 0.0)  # not even back
    assert link.last == STOP
    driver.tick((5.0, 5.0, 5.0, 5.0))
    assert link.last == STOP
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last[0] == pytest.approx(8.0)


def test_stale_feedback_stops_until_it_is_fresh() -> None:
    driver, link = robot(feedback_timeout=1.0)
    driver.drive(0.4, 0.0)
    stale = 0
    link.silent = True
    for _ in range(95):
        driver.drive(0.4, 0.0)
        stale += driver.safety.reason is Reason.STALE_FEEDBACK
    assert stale == pytest.approx(15, abs=2)
    assert link.last == STOP

    link.silent = False
    for _ in range(2):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.NONE
    assert link.last[0] == pytest.approx(8.0)


def test_emergency_stop_is_latched() -> None:
    driver, link = robot()
    driver.drive(0.4, 0.0)
    driver.estop()
    assert link.last == STOP
    driver.release_estop()
    for _ in range(50):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.EMERGENCY_STOP  # nothing turns before a reset
    assert link.last == STOP

    driver.estop()
    for _ in range(2):
        with pytest.raises(EmergencyStopError):
            driver.reset(Scene())
    driver.release_estop()
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last[0] == pytest.approx(8.0)


def test_sent_twist_and_reason_are_in_info() -> None:
    config = ACSAR.with_(linear_limits={"max_velocity": 0.2})
    env: Any = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", robot=config)
    env.reset(seed=0)
    for sent, reason in ((0.2, 1.0), (0.0, 4.0)):
        *_, info = env.step(np.array([1.0, 0.0], np.float32))
        assert (info["sent_linear"], info["sent_reason"]) == (pytest.approx(sent), reason)
        env.unwrapped.robot.estop()
    env.close()

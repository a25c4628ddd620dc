"""The safety layer on a simulated robot: what is sent, why, and until when."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig
from acsar_gym.env import RobotEnv
from acsar_gym.links import open_link
from acsar_gym.protocol import Decoder
from acsar_gym.safety import Reason
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")


class Tapped:
    """A planar link that remembers what was written to it, and can fall silent."""

    def __init__(self, config: RobotConfig) -> None:
        self._link = open_link("planar", config)
        self.written = b""
        self.silent = False

    def write(self, data: bytes) -> None:
        self.written += data
        self._link.write(data)

    def advance(self, period: float) -> bytes:
        got = self._link.advance(period)
        return b"" if self.silent else got

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def last(self) -> tuple[float | None, ...]:
        """The newest command's wheel speeds."""
        return Decoder().feed(self.written)[-1].speeds


def robot(**fields: Any) -> tuple[Robot, Tapped]:
    config = ACSAR.with_(**fields)
    link = Tapped(config)
    made = Robot(link, config)
    made.activate()
    return made, link


def test_what_is_sent_is_what_was_asked() -> None:
    driver, _ = robot()
    driver.drive(0.3, -0.5)
    assert driver.safety.sent == pytest.approx((0.3, -0.5))
    assert driver.safety.reason is Reason.NONE


def test_wheels_at_their_top_are_a_limit() -> None:
    driver, _ = robot(max_wheel_speed=2.0)
    driver.drive(0.5, 0.0)
    assert driver.safety.sent == pytest.approx((0.1, 0.0))
    assert driver.safety.reason is Reason.LIMITS


def test_acceleration_limits_ramp_the_commands_on_the_wire() -> None:
    driver, link = robot(linear_limits={"max_acceleration": 1.0})
    seen = []
    for _ in range(40):
        driver.drive(0.3, 0.0)
        seen.append(link.last()[0])
    assert seen[:3] == pytest.approx([0.2, 0.4, 0.6])  # 0.01 m/s a tick, radius 0.05 m
    assert seen[-1] == pytest.approx(6.0)
    assert driver.safety.reason is Reason.NONE


def test_a_stop_is_no_ramp() -> None:
    driver, link = robot(linear_limits={"max_acceleration": 1.0})
    for _ in range(40):
        driver.drive(0.3, 0.0)
    driver.stop()
    assert link.last() == (0.0,) * 4
    driver.drive(0.3, 0.0)
    assert link.last()[0] == pytest.approx(0.2)  # from standstill again


def test_the_geofence_stops_until_the_reset() -> None:
    driver, link = robot(geofence={"max_x": 0.2})
    for _ in range(300):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.GEOFENCE
    assert driver.safety.sent == (0.0, 0.0)
    assert link.last() == (0.0,) * 4
    assert 0.2 < driver.odometry.pose[0] < 0.3
    driver.drive(-0.4, 0.0)  # not even back
    assert link.last() == (0.0,) * 4
    driver.tick((5.0, 5.0, 5.0, 5.0))
    assert link.last() == (0.0,) * 4
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last()[0] == pytest.approx(8.0)


def test_stale_feedback_stops_until_it_is_fresh() -> None:
    driver, link = robot(feedback_timeout=1.0)
    driver.drive(0.4, 0.0)
    link.silent = True
    reasons = []
    for _ in range(95):
        driver.drive(0.4, 0.0)
        reasons.append(driver.safety.reason)
    assert reasons.count(Reason.STALE_FEEDBACK) == pytest.approx(15, abs=2)
    assert link.last() == (0.0,) * 4
    link.silent = False
    driver.drive(0.4, 0.0)
    driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.NONE
    assert link.last()[0] == pytest.approx(8.0)


def test_an_emergency_stop_is_latched() -> None:
    driver, link = robot()
    driver.drive(0.4, 0.0)
    driver.estop()
    assert link.last() == (0.0,) * 4
    for _ in range(50):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.EMERGENCY_STOP
    assert link.last() == (0.0,) * 4
    assert max(map(abs, driver.speeds)) < 0.1
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last()[0] == pytest.approx(8.0)


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_info_says_what_was_sent_and_why(link: str) -> None:
    config = ACSAR.with_(linear_limits={"max_velocity": 0.2})
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=config)
    _, info = env.reset(seed=0)
    assert (info["sent_linear"], info["sent_reason"]) == (0.0, 0.0)
    *_, info = env.step(np.array([1.0, 0.0], np.float32))
    assert info["sent_linear"] == pytest.approx(0.2)
    assert info["sent_reason"] == Reason.LIMITS
    assert isinstance(env.unwrapped, RobotEnv)
    env.unwrapped.robot.estop()
    *_, info = env.step(np.array([1.0, 0.0], np.float32))
    assert (info["sent_linear"], info["sent_reason"]) == (0.0, 4.0)
    env.close()

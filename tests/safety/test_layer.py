"""The safety layer on a simulated robot: what is sent, why, and until when."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, kinematics
from acsar_gym.envs.robot_env import RobotEnv
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
    assert driver.safety.reason is Reason.LIMITS
    assert (np.abs(driver.safety.sent) <= (ACSAR.max_linear + 1e-9, ACSAR.max_angular + 1e-9)).all()
    twist = kinematics.forward(link.last, ACSAR.wheel_radius, ACSAR.effective_separation)
    assert twist == pytest.approx(driver.safety.sent, abs=WIRE)


@pytest.mark.parametrize(
    ("fields", "speed", "sent"),
    [
        ({}, 30.0, 10.0),  # 0.5 m/s at a radius of 0.05 m
        ({"max_wheel_speed": 2.0}, 4.0, 2.0),
        ({"linear_limits": {"min_velocity": 0.0}}, -3.0, 0.0),
    ],
)
def test_bounded_wheel_speeds(fields: dict[str, Any], speed: float, sent: float) -> None:
    driver, link = robot(**fields)
    driver.tick((speed,) * 4)
    assert link.last == pytest.approx((sent,) * 4)
    assert driver.safety.reason is Reason.LIMITS


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
    link.silent = True
    reasons = []
    for _ in range(95):
        driver.drive(0.4, 0.0)
        reasons.append(driver.safety.reason)
    assert reasons.count(Reason.STALE_FEEDBACK) == pytest.approx(15, abs=2)
    assert link.last == STOP

    link.silent = False
    driver.drive(0.4, 0.0)
    driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.NONE
    assert link.last[0] == pytest.approx(8.0)


def test_emergency_stop_is_latched() -> None:
    driver, link = robot()
    driver.drive(0.4, 0.0)
    driver.estop()
    assert link.last == STOP
    for _ in range(50):
        driver.drive(0.4, 0.0)
    assert driver.safety.reason is Reason.EMERGENCY_STOP
    assert link.last == STOP
    for _ in range(2):
        with pytest.raises(EmergencyStopError):
            driver.reset(Scene())

    driver.release_estop()
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last[0] == pytest.approx(8.0)


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_sent_twist_and_reason_are_in_info(link: str) -> None:
    config = ACSAR.with_(linear_limits={"max_velocity": 0.2})
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=config)
    env.reset(seed=0)
    *_, info = env.step(np.array([1.0, 0.0], np.float32))
    assert info["sent_linear"] == pytest.approx(0.2)
    assert info["sent_reason"] == Reason.LIMITS
    assert isinstance(env.unwrapped, RobotEnv)
    env.unwrapped.robot.estop()
    *_, info = env.step(np.array([1.0, 0.0], np.float32))
    assert (info["sent_linear"], info["sent_reason"]) == (0.0, 4.0)
    env.close()

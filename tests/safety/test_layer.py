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

ACSAR = RobotConfig.preset("acsar")
AT_ONCE: dict[str, Any] = {
    "linear_limits": {"max_acceleration": None},
    "angular_limits": {"max_acceleration": None},
}
"""No limit of acceleration."""


class Tapped(LinkWrapper):
    """A planar link that remembers what was written to it, and can fall silent."""

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(open_link("planar", config))
        self.written = b""
        self.silent = False

    def write(self, data: bytes) -> None:
        self.written += data
        self.inner.write(data)

    def advance(self, period: float) -> bytes:
        got = self.inner.advance(period)
        return b"" if self.silent else got

    def last(self) -> tuple[float | None, ...]:
        """The newest command's wheel speeds."""
        return Decoder().feed(self.written)[-1].speeds


def robot(**fields: Any) -> tuple[Robot, Tapped]:
    """An active one, without limits of acceleration but for those of `fields`."""
    config = ACSAR.with_(**AT_ONCE).with_(**fields)
    link = Tapped(config)
    made = Robot(link, config)
    made.activate()
    return made, link


def twist(speeds: tuple[float | None, ...]) -> tuple[float, float]:
    """Of four wheel speeds on the wire [m/s, rad/s]."""
    return kinematics.forward(
        [speed or 0.0 for speed in speeds], ACSAR.wheel_radius, ACSAR.effective_separation
    )


WIRE = 0.002
"""What the wire's two decimals change of a twist, at most [m/s, rad/s]."""


@pytest.mark.parametrize(
    ("linear", "angular"), [(2.0, 0.0), (-2.0, 0.0), (0.0, 9.0), (0.4, -7.0), (1e6, 1e6)]
)
def test_no_twist_exceeds_the_full_speeds(linear: float, angular: float) -> None:
    driver, link = robot()
    driver.drive(0.3, -0.5)
    assert driver.safety.sent == pytest.approx((0.3, -0.5))
    reasons = [driver.safety.reason]
    driver.drive(linear, angular)
    assert [*reasons, driver.safety.reason] == [Reason.NONE, Reason.LIMITS]
    assert abs(driver.safety.sent[0]) <= ACSAR.max_linear + 1e-9
    assert abs(driver.safety.sent[1]) <= ACSAR.max_angular + 1e-9
    assert twist(link.last()) == pytest.approx(driver.safety.sent, abs=WIRE)


@pytest.mark.parametrize(
    ("fields", "asked", "sent", "reason"),
    [
        ({}, 30.0, 10.0, Reason.LIMITS),  # 0.5 m/s at a radius of 0.05 m
        ({"max_wheel_speed": 2.0}, 4.0, 2.0, Reason.LIMITS),
        ({"linear_limits": {"min_velocity": 0.0}}, -3.0, 0.0, Reason.LIMITS),  # it stands instead
    ],
)
def test_raw_wheel_speeds_are_bounded_on_the_wire(
    fields: dict[str, Any], asked: float, sent: float, reason: Reason
) -> None:
    driver, link = robot(**fields)
    driver.tick((asked,) * 4)
    assert link.last() == pytest.approx((sent,) * 4)
    assert driver.safety.reason is reason


def test_acceleration_limits_ramp_commands_but_no_stop() -> None:
    driver, link = robot(linear_limits={"max_acceleration": 1.0})
    for drives in (True, False):
        seen = []
        for _ in range(40):
            driver.drive(0.3, 0.0)
            seen.append(link.last()[0])
        assert seen[:3] == pytest.approx([0.2, 0.4, 0.6])  # 0.01 m/s a tick, radius 0.05 m
        assert seen[-1] == pytest.approx(6.0)
        assert driver.safety.reason is Reason.NONE
        if drives:
            driver.drive(0.0, 0.0)
        else:
            driver.stop()
        assert link.last() == (0.0,) * 4
    driver.tick((6.0, 6.0, 6.0, 6.0))
    driver.drive(0.5, 0.0)
    assert link.last()[0] == pytest.approx(6.2)  # from where raw wheel speeds have ended


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
    for _ in range(2):
        with pytest.raises(EmergencyStopError):
            driver.reset(Scene())
    driver.release_estop()
    driver.reset(Scene())
    driver.drive(0.4, 0.0)
    assert link.last()[0] == pytest.approx(8.0)


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_info_says_what_was_sent_and_why(link: str) -> None:
    config = ACSAR.with_(linear_limits={"max_velocity": 0.2})  # reached within the step
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

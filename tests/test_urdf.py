"""The robot's URDF says the same as its preset, and rolls on its wheels in PyBullet."""

from __future__ import annotations

from typing import Any

import pybullet
import pytest
from defusedxml import ElementTree
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

from acsar_gym import RobotConfig
from acsar_gym.resources import ASSETS

URDF = ASSETS / "robots" / "acsar.urdf"
WHEELS = ("front_right_wheel", "front_left_wheel", "rear_left_wheel", "rear_right_wheel")
SPEED = 6.0
"""Of the wheels [rad/s]."""
SECONDS = 1.5


@pytest.fixture
def client() -> Any:
    """A PyBullet with gravity and a floor, which ends with the test."""
    client: Any = BulletClient(pybullet.DIRECT)
    client.setGravity(0.0, 0.0, -9.81)
    client.createMultiBody(0.0, client.createCollisionShape(pybullet.GEOM_PLANE))
    return client


def run(client: Any, seconds: float) -> None:
    for _ in range(round(seconds * 240)):
        client.stepSimulation()


def test_urdf_rolls_on_its_wheels_in_pybullet(client: Any) -> None:
    config = RobotConfig.preset("acsar")
    robot = client.loadURDF(str(URDF), [0.0, 0.0, 0.005])
    links = {"base_footprint": -1}
    for joint in range(client.getNumJoints(robot)):
        info = client.getJointInfo(robot, joint)
        links[info[12].decode()] = joint
    masses = (client.getDynamicsInfo(robot, n)[0] for n in links.values())
    assert sum(masses) == pytest.approx(config.body.mass)

    run(client, 0.5)
    contacts = client.getContactPoints(robot)
    assert {contact[3] for contact in contacts} == {links[wheel] for wheel in WHEELS}
    for wheel in WHEELS:
        client.setJointMotorControl2(
            robot,
            links[wheel],
            pybullet.VELOCITY_CONTROL,
            targetVelocity=SPEED,
            force=1.5,
        )
    run(client, SECONDS)
    (x, y, z), _ = client.getBasePositionAndOrientation(robot)
    assert x == pytest.approx(config.wheel_radius * SPEED * SECONDS, rel=0.05)
    assert (y, z) == pytest.approx((0.0, 0.0), abs=0.005)


def test_urdf_agrees_with_the_preset() -> None:
    loaded = RobotConfig.load(URDF)
    assert loaded.serial_port == "/dev/ttyUSB0"
    config = RobotConfig.preset("acsar")
    assert loaded.with_(serial_port=None) == config
    (origin,) = ElementTree.fromstring(URDF.read_text()).iterfind(
        "joint[@name='front_left_wheel_joint']/origin"
    )
    x, y, _ = map(float, origin.attrib["xyz"].split())
    assert (2.0 * x, 2.0 * y) == pytest.approx((config.wheelbase, config.wheel_separation))

"""The robot's URDF and its preset describe the same robot."""

from __future__ import annotations

import pytest
from defusedxml import ElementTree

from acsar_gym import RobotConfig
from acsar_gym.resources import ASSETS

URDF = ASSETS / "robots" / "acsar.urdf"


def test_urdf_parameters_and_preset_agree() -> None:
    loaded = RobotConfig.load(URDF)
    assert loaded.serial_port == "/dev/ttyUSB0"
    assert loaded.with_(serial_port=None) == RobotConfig.preset("acsar")


def test_joints_stand_where_the_parameters_say() -> None:
    config = RobotConfig.preset("acsar")
    root = ElementTree.fromstring(URDF.read_text())
    (origin,) = root.iterfind("joint[@name='front_left_wheel_joint']/origin")
    x, y, _ = map(float, origin.attrib["xyz"].split())
    assert (2.0 * x, 2.0 * y) == pytest.approx((config.wheelbase, config.wheel_separation))
    masses = [float(mass.attrib["value"]) for mass in root.iter("mass")]
    assert sum(masses) == pytest.approx(config.body.mass)

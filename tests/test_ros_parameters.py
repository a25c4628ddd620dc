"""Parameters of ros2_control and of an EKF, and the board's config.h: the presets' numbers."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml
from defusedxml import ElementTree

from acsar_gym import RobotConfig
from acsar_gym.config import SpeedLimits
from acsar_gym.resources import ASSETS

URDF = ASSETS / "robots" / "acsar.urdf"
ACSAR = RobotConfig.preset("acsar")


def parameters(file: str, node: str) -> dict[str, Any]:
    """Parameters of a node."""
    read = yaml.safe_load((ASSETS / "ros" / "config" / file).read_text(encoding="utf-8"))
    found = read[node]["ros__parameters"]
    assert isinstance(found, dict)
    return found


def test_diff_drive_controller_has_the_presets_numbers() -> None:
    ours = parameters("controllers.yaml", "diff_drive_controller")
    for name in (
        *("wheel_radius", "wheel_separation", "wheel_separation_multiplier"),
        *("left_wheel_radius_multiplier", "right_wheel_radius_multiplier"),
    ):
        assert ours[name] == getattr(ACSAR, name), name
    assert ours["odom_frame_id"] == ACSAR.odom_frame
    assert ours["publish_rate"] == ACSAR.feedback_rate
    assert ours["cmd_vel_timeout"] == ACSAR.firmware.command_timeout
    manager = parameters("controllers.yaml", "controller_manager")
    assert manager["update_rate"] == ACSAR.control_rate


@pytest.mark.parametrize(
    ("axis", "most", "limits"),
    [
        ("linear.x", ACSAR.max_linear, ACSAR.linear_limits),
        ("angular.z", ACSAR.max_angular, ACSAR.angular_limits),
    ],
)
def test_its_limits_are_the_presets(axis: str, most: float, limits: SpeedLimits) -> None:
    ours = parameters("controllers.yaml", "diff_drive_controller")
    acceleration = limits.max_acceleration
    assert acceleration is not None
    assert limits.model_dump(exclude_none=True) == {"max_acceleration": acceleration}
    assert {name: value for name, value in ours.items() if name.startswith(axis)} == {
        f"{axis}.max_velocity": most,
        f"{axis}.min_velocity": -most,
        f"{axis}.max_acceleration": acceleration,
        f"{axis}.max_deceleration": -acceleration,
    }


def test_its_joints_and_frames_are_the_urdfs() -> None:
    ours = parameters("controllers.yaml", "diff_drive_controller")
    filter_ = parameters("ekf.yaml", "ekf_filter_node")
    root = ElementTree.fromstring(URDF.read_text())
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name in ours[f"{side}_wheel_names"]:
            (origin,) = root.iterfind(f"joint[@name='{name}']/origin")
            assert sign * float(origin.attrib["xyz"].split()[1]) > 0.0
            (joint,) = root.iterfind(f"ros2_control/joint[@name='{name}']")
            states = {state.attrib["name"] for state in joint.iterfind("state_interface")}
            assert states == {"position", "velocity"}
    (plugin,) = root.iterfind("ros2_control/hardware/plugin")
    assert plugin.text == "acsar_hardware/ACSARInterface"
    children = {child.attrib["link"] for child in root.iterfind("joint/child")}
    (first,) = {link.attrib["name"] for link in root.iterfind("link")} - children
    assert ours["base_frame_id"] == filter_["base_link_frame"] == first == "base_footprint"


def test_the_filter_agrees_with_controller_and_preset() -> None:
    ours = parameters("controllers.yaml", "diff_drive_controller")
    filter_ = parameters("ekf.yaml", "ekf_filter_node")
    assert filter_["odom_frame"] == filter_["world_frame"] == ACSAR.odom_frame
    assert filter_["frequency"] == ACSAR.control_rate
    assert filter_["sensor_timeout"] == ACSAR.feedback_timeout
    assert filter_["publish_tf"] != ours["enable_odom_tf"]  # one of them
    used = [number for number, on in enumerate(filter_["odom0_config"]) if on]
    assert used == [6, 11]  # vx and vyaw of 15 states: wheels don't measure vy
    assert len(filter_["odom0_config"]) == 15


def test_the_boards_program_has_the_numbers_of_its_preset() -> None:
    text = (ASSETS / "firmware" / "acsar" / "config.h").read_text(encoding="utf-8")
    found = dict(re.findall(r"^#define (\w+) +([0-9.]+)(?:UL)?\b", text, flags=re.MULTILINE))
    numbers = {name: float(value) for name, value in found.items()}
    config = RobotConfig.preset("acsar_avr")
    assert numbers["BAUD_RATE"] == config.baud_rate
    assert numbers["FEEDBACK_RATE"] == config.feedback_rate
    assert numbers["COMMAND_TIMEOUT_MS"] / 1000.0 == config.firmware.command_timeout
    assert numbers["LOOP_RATE"] == config.firmware.loop_rate
    assert numbers["COUNTS_PER_TURN"] == config.encoder.counts_per_revolution
    assert numbers["WINDOW_LINES"] / numbers["FEEDBACK_RATE"] == config.encoder.window
    assert numbers["MAX_SPEED"] == config.motor.max_speed
    assert numbers["ACCELERATION"] == config.motor.acceleration
    assert numbers["TIME_CONSTANT"] == config.motor.time_constant
    same = {"motor": ACSAR.motor, "encoder": ACSAR.encoder, "firmware": ACSAR.firmware}
    assert config.model_copy(update=same) == ACSAR

"""Parameters of ros2_control and of an EKF, and the board's config.h: the presets' numbers."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml
from defusedxml import ElementTree

from acsar_gym import RobotConfig
from acsar_gym.resources import ASSETS

URDF = ASSETS / "robots" / "acsar.urdf"
ACSAR = RobotConfig.preset("acsar")


def parameters(file: str, node: str) -> dict[str, Any]:
    """Parameters of a node."""
    data = yaml.safe_load((ASSETS / "ros" / "config" / file).read_text(encoding="utf-8"))
    node_parameters: dict[str, Any] = data[node]["ros__parameters"]
    return node_parameters


CONTROLLER = parameters("controllers.yaml", "diff_drive_controller")
EKF = parameters("ekf.yaml", "ekf_filter_node")


def test_diff_drive_controller_has_the_presets_numbers() -> None:
    for name in (
        *("wheel_radius", "wheel_separation", "wheel_separation_multiplier"),
        *("left_wheel_radius_multiplier", "right_wheel_radius_multiplier"),
    ):
        assert CONTROLLER[name] == getattr(ACSAR, name), name
    assert CONTROLLER["odom_frame_id"] == ACSAR.odom_frame
    assert CONTROLLER["publish_rate"] == ACSAR.feedback_rate
    assert CONTROLLER["cmd_vel_timeout"] == ACSAR.firmware.command_timeout
    manager = parameters("controllers.yaml", "controller_manager")
    assert manager["update_rate"] == ACSAR.control_rate

    for axis in ("linear.x", "angular.z"):
        word = axis.partition(".")[0]
        top = getattr(ACSAR, f"max_{word}")
        (limit,) = getattr(ACSAR, f"{word}_limits").model_dump(exclude_none=True).values()
        limits = {"max_velocity": top, "min_velocity": -top}
        limits |= {"max_acceleration": limit, "max_deceleration": -limit}
        read = {name: value for name, value in CONTROLLER.items() if name.startswith(axis)}
        assert read == {f"{axis}.{name}": value for name, value in limits.items()}


def test_diff_drive_controller_has_the_joints_and_frames_of_the_urdf() -> None:
    root = ElementTree.fromstring(URDF.read_text())
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name in CONTROLLER[f"{side}_wheel_names"]:
            (origin,) = root.iterfind(f"joint[@name='{name}']/origin")
            assert sign * float(origin.attrib["xyz"].split()[1]) > 0.0
            (joint,) = root.iterfind(f"ros2_control/joint[@name='{name}']")
            states = {state.attrib["name"] for state in joint.iterfind("state_interface")}
            assert states == {"position", "velocity"}

    (plugin,) = root.iterfind("ros2_control/hardware/plugin")
    assert plugin.text == "acsar_hardware/ACSARInterface"
    children = {child.attrib["link"] for child in root.iterfind("joint/child")}
    (first,) = {link.attrib["name"] for link in root.iterfind("link")} - children
    assert CONTROLLER["base_frame_id"] == EKF["base_link_frame"] == first == "base_footprint"


def test_ekf_agrees_with_controller_and_preset() -> None:
    assert EKF["odom_frame"] == EKF["world_frame"] == ACSAR.odom_frame
    assert EKF["frequency"] == ACSAR.control_rate
    assert EKF["sensor_timeout"] == ACSAR.feedback_timeout
    assert EKF["publish_tf"] != CONTROLLER["enable_odom_tf"]  # one of them
    used = [number for number, on in enumerate(EKF["odom0_config"]) if on]
    assert used == [6, 11]  # vx and vyaw of 15 states: wheels don't measure vy
    assert len(EKF["odom0_config"]) == 15


def test_firmware_has_the_numbers_of_its_preset() -> None:
    text = (ASSETS / "firmware" / "acsar" / "config.h").read_text(encoding="utf-8")
    defined = re.findall(r"^#define (\w+) +([0-9.]+)(?:UL)?\b", text, flags=re.MULTILINE)
    numbers = {name: float(value) for name, value in defined}
    config = RobotConfig.preset("acsar_avr")
    timeout = config.firmware.command_timeout
    assert timeout is not None
    expected = {
        "BAUD_RATE": config.baud_rate,
        "FEEDBACK_RATE": config.feedback_rate,
        "COMMAND_TIMEOUT_MS": 1000.0 * timeout,
        "LOOP_RATE": config.firmware.loop_rate,
        "COUNTS_PER_TURN": config.encoder.counts_per_revolution,
        "WINDOW_LINES": config.encoder.window * config.feedback_rate,
        "MAX_SPEED": config.motor.max_speed,
        "ACCELERATION": config.motor.acceleration,
        "TIME_CONSTANT": config.motor.time_constant,
    }
    assert {name: numbers[name] for name in expected} == pytest.approx(expected)

    same = {"motor": ACSAR.motor, "encoder": ACSAR.encoder, "firmware": ACSAR.firmware}
    assert config.model_copy(update=same) == ACSAR

"""identify, calibrate, doctor and the wheel check over ROS, of robots whose truth is known."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ros_tools import ForeignRobot, StartProgram, StartRobot

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError

JOINTS = ["arm", "rr=d", "fl=b", "fr=a", "rl=c"]
FOX: dict[str, Any] = {
    "name": "fox",
    "wheel_radius": 0.05,
    "wheel_separation": 0.3,
    "wheelbase": 0.3,
    "firmware": {"feedback_rate": 50.0},
    "feedback_timeout": 2.0,  # a busy computer doesn't end a test
    "watchdog_timeout": 2.0,
    "ros2": {"joints": ["fr", "fl", "rl", "rr"]},
}
"""What is known of the foreign robot."""


def save(folder: Path, **ros2: Any) -> Path:
    """A robot's file."""
    path = folder / "fox.yaml"
    RobotConfig(**FOX | {"ros2": FOX["ros2"] | ros2}).save(path)
    return path


def run(start_program: StartProgram, arguments: Sequence[object]) -> None:
    """Run a command, which must end well."""
    program = start_program("-m", "acsar_gym", *arguments)
    status = program.process.wait(120.0)
    assert status == 0, program.printed


def read_intervals(path: Path) -> dict[str, tuple[float, float]]:
    """Intervals of an identification, by name and wheel."""
    return {
        f"{finding['name']}{finding['wheel']}": (finding["low"], finding["high"])
        for finding in json.loads(path.read_text())["findings"]
        if finding["value"] is not None
    }


def list_rests(robot: ForeignRobot) -> list[Sequence[float]]:
    """True poses at which it was at rest, one after the other."""
    poses: list[Sequence[float]] = []
    moves = True
    for state in robot.states:
        if max(map(abs, state["speeds"])) > 0.02:
            moves = True
        elif moves:
            poses.append(state["pose"])
            moves = False
        else:
            poses[-1] = state["pose"]
    return poses


def test_identify_finds_a_controllers_delay(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    start_robot(joints=JOINTS, delay=0.09, time_constant=0.13, multiplier=1.3, cmd_vel_timeout=0.4)
    robot_file = save(tmp_path, wheel_separation=0.39)
    out = tmp_path / "found.yaml"
    findings = tmp_path / "found.json"
    log = tmp_path / "drive.mcap"
    command = ("identify", f"ros2:{namespace}", "--yes", "--duration", 13, "--robot", robot_file)
    files = ("--out", out, "--json", findings, "--record", log)
    run(start_program, (*command, *files, "--anyway"))  # on a busy computer commands come late

    intervals = read_intervals(findings)
    truth = {
        "firmware.command_delay": 0.09,
        "firmware.command_timeout": 0.4,
        "firmware.feedback_rate": 50.0,
        "motor.time_constant": 0.13,
        "motor.gain": 1.0,
    }
    for name, value in truth.items():
        for key in [name] if name in intervals else [f"{name}{letter}" for letter in "abcd"]:
            low, high = intervals[key]
            assert low <= value <= high, (key, value, low, high)
    assert RobotConfig.load(out).effective_separation == 0.3  # which is odometry's

    # The twin answers as the robot did, a recording of it included.
    gap = tmp_path / "gap.json"
    run(start_program, ("gap", log, "--robot", out, "--json", gap))
    preset, twin = (json.loads(gap.read_text())[side]["figures"] for side in ("before", "after"))
    assert twin["wheel_speed_rms"] < 0.5 * preset["wheel_speed_rms"]
    assert abs(twin["time_shift"]) < 0.02 < preset["time_shift"]


def test_calibrate_finds_radius_and_multiplier(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    robot = start_robot(joints=JOINTS, delay=0.05, multiplier=1.2, true_multiplier=1.5)
    log = tmp_path / "runs.mcap"
    out = tmp_path / "found.yaml"
    robot_file = save(tmp_path, wheel_separation=0.36)
    command = ("calibrate", f"ros2:{namespace}", "all", "--yes", "--robot", robot_file)
    runs = ("--distance", 0.7, "--turns", 0.7, "--repeats", 1, "--speeds", 1.5)
    run(start_program, (*command, *runs, "--space", 3, 3, "--record", log))

    straight, turn = pairwise(list_rests(robot))
    way = math.dist(straight[0][:2], straight[1][:2])
    degrees = math.degrees(turn[1][2] - turn[0][2])
    readings = ("--measured", f"{way:.3f}", "--measured-deg", f"{degrees:.0f}")
    run(start_program, ("calibrate", log, "all", "--out", out, *readings))
    config = RobotConfig.load(out)
    for name, value in (("wheel_separation_multiplier", 1.5), ("wheel_radius", 0.05)):
        interval = config.measured[name]
        assert interval.low <= value <= interval.high
    assert config.twist_geometry == (0.05, 0.05, 0.36)  # its controller takes twists as before


def drive_to_and_fro(url: str, config: RobotConfig) -> None:
    """Drive hard."""
    with Robot(open_link(url, config), config) as robot:
        for tick in range(300):
            linear = (0.5, -0.5, 0.0, 0.3)[tick // 60 % 4]
            robot.drive(linear, (0.0, 1.0, -1.5)[tick // 80 % 3])


def test_wheel_check_accepts_a_late_controller(start_robot: StartRobot, namespace: str) -> None:
    start_robot(joints=JOINTS, delay=0.2, time_constant=0.25, multiplier=1.5)
    drive_to_and_fro(f"ros2:{namespace}", RobotConfig(**FOX))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (["rr=d", "fl=b", "fr=a", "rl"], "rear_left stands still"),
        (["rr=c", "fl=b", "fr=a", "rl=d"], "rear_(left|right)"),
    ],
    ids=["dead", "swapped"],
)
def test_wheel_check_names_wheels_that_dont_follow(
    joints: list[str], message: str, start_robot: StartRobot, namespace: str
) -> None:
    start_robot(joints=joints, delay=0.1)
    with pytest.raises(WheelError, match=message) as raised:
        drive_to_and_fro(f"ros2:{namespace}", RobotConfig(**FOX))
    assert "check ros2.joints" in str(raised.value)


def test_doctor_reports_a_robot_in_ros(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    start_robot(joints=JOINTS, rate=20.0)
    path = tmp_path / "checks.json"
    command = ("doctor", f"ros2:{namespace}", "--robot", save(tmp_path), "--json", path)
    run(start_program, command)

    checks = {check["name"]: check for check in json.loads(path.read_text())["checks"]}
    assert f"{namespace}/cmd_vel (geometry_msgs/msg/TwistStamped)" in checks["topics"]["found"]
    assert checks["feedback rate"]["status"] == "warn"
    assert "feedback_rate: 20" in checks["feedback rate"]["fix"]
    assert checks["other commanders"]["status"] == "ok"
    publishers = f"1 of {namespace}/joint_states: {namespace}/foreign_robot"
    assert checks["publishers"]["found"] == publishers

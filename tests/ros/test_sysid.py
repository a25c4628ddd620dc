"""identify, calibrate, doctor and the wheel check over ROS, of robots whose truth is known."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ros_tools import ForeignRobot, Program, StartProgram, StartRobot

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError

JOINTS = ("arm", "rr=d", "fl=b", "fr=a", "rl=c")
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
STANDING = 0.02
"""Wheels below this stand [rad/s]."""


def save(folder: Path, **changes: Any) -> Path:
    """A robot's file."""
    path = folder / "fox.yaml"
    RobotConfig(**FOX | changes).save(path)
    return path


def run(program: Program) -> str:
    """What a command prints that ends well."""
    status = program.process.wait(120.0)
    assert status == 0, program.printed
    return program.printed


def intervals(path: Path) -> dict[str, tuple[float, float]]:
    """Intervals of what was found, by name and wheel."""
    findings = json.loads(path.read_text())["findings"]
    return {
        f"{one['name']}{one['wheel']}": (one["low"], one["high"])
        for one in findings
        if one["value"] is not None
    }


def check_holds(found: dict[str, tuple[float, float]], truth: dict[str, float]) -> None:
    """Check that intervals hold the truth."""
    for name, value in truth.items():
        for key in [name] if name in found else [f"{name}{letter}" for letter in "abcd"]:
            low, high = found[key]
            assert low <= value <= high, (key, value, low, high)


def rests(robot: ForeignRobot) -> list[Sequence[float]]:
    """True poses at which it stood, one after the other."""
    poses: list[Sequence[float]] = []
    moves = True
    for state in robot.states:
        if max(map(abs, state["speeds"])) > STANDING:
            moves = True
        elif moves:
            poses.append(state["pose"])
            moves = False
        else:
            poses[-1] = state["pose"]
    return poses


def test_a_foreign_robot_is_identified_with_its_controllers_delay(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    start_robot(
        *("--joints", *JOINTS, "--delay", 0.09, "--time-constant", 0.13),
        *("--multiplier", 1.3, "--cmd-vel-timeout", 0.4),
    )
    out, findings = tmp_path / "found.yaml", tmp_path / "found.json"
    log = tmp_path / "drive.mcap"
    known = save(tmp_path, ros2=FOX["ros2"] | {"wheel_separation": 0.39})
    run(
        start_program(
            *("-m", "acsar_gym", "identify", f"ros2:{namespace}", "--yes", "--duration", 13),
            *("--robot", known, "--out", out, "--json", findings, "--record", log),
            "--anyway",  # on a busy computer the robot takes commands late, now and then
        )
    )
    truth = {
        "firmware.command_delay": 0.09,
        "firmware.command_timeout": 0.4,
        "firmware.feedback_rate": 50.0,
        "motor.time_constant": 0.13,
        "motor.gain": 1.0,
    }
    check_holds(intervals(findings), truth)
    assert RobotConfig.load(out).effective_separation == 0.3  # which is odometry's
    # The twin answers as the robot did, a recording of it included.
    gap = tmp_path / "gap.json"
    run(start_program("-m", "acsar_gym", "gap", log, "--robot", out, "--json", gap))
    before, after = (json.loads(gap.read_text())[side]["figures"] for side in ("before", "after"))
    assert after["wheel_speed_rms"] < 0.5 * before["wheel_speed_rms"]
    assert abs(after["time_shift"]) < 0.02 < before["time_shift"]


def test_a_foreign_robot_is_calibrated(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    robot = start_robot(
        *("--joints", *JOINTS, "--delay", 0.05, "--multiplier", 1.2, "--true-multiplier", 1.5),
        *("--radius", 0.05),
    )
    log, out = tmp_path / "runs.mcap", tmp_path / "found.yaml"
    known = save(tmp_path, ros2=FOX["ros2"] | {"wheel_separation": 0.36})
    run(
        start_program(
            *("-m", "acsar_gym", "calibrate", f"ros2:{namespace}", "all", "--yes"),
            *("--robot", known, "--record", log, "--space", 3, 3, "--distance", 0.7),
            *("--turns", 0.7, "--repeats", 1, "--speeds", 1.5),
        )
    )
    driven = list(pairwise(rests(robot)))
    assert len(driven) == 2
    (begin, end), (before, after) = driven
    way, turn = math.dist(begin[:2], end[:2]), math.degrees(after[2] - before[2])
    run(
        start_program(
            *("-m", "acsar_gym", "calibrate", log, "all", "--out", out),
            *("--measured", f"{way:.3f}", "--measured-deg", f"{turn:.0f}"),
        )
    )
    found = RobotConfig.load(out)
    for name, value in (("wheel_separation_multiplier", 1.5), ("wheel_radius", 0.05)):
        interval = found.measured[name]
        assert interval.low <= value <= interval.high
    # Its controller goes on taking twists as it did.
    assert found.twist_geometry == (0.05, 0.05, 0.36)


def drive_to_and_fro(url: str, config: RobotConfig) -> None:
    """Drive hard."""
    with Robot(open_link(url, config), config) as robot:
        for tick in range(300):
            linear = (0.5, -0.5, 0.0, 0.3)[tick // 60 % 4]
            robot.drive(linear, (0.0, 1.0, -1.5)[tick // 80 % 3])


def test_wheels_behind_a_late_controller_are_no_fault(
    start_robot: StartRobot, namespace: str
) -> None:
    start_robot("--joints", *JOINTS, "--delay", 0.2, "--time-constant", 0.25, "--multiplier", 1.5)
    drive_to_and_fro(f"ros2:{namespace}", RobotConfig(**FOX))


@pytest.mark.parametrize(
    ("joints", "said"),
    [
        (("rr=d", "fl=b", "fr=a", "rl"), "rear_left stands still"),
        (("rr=c", "fl=b", "fr=a", "rl=d"), "rear_(left|right)"),
    ],
    ids=["dead", "swapped"],
)
def test_wheels_that_dont_follow_are_a_fault(
    joints: tuple[str, ...], said: str, start_robot: StartRobot, namespace: str
) -> None:
    start_robot("--joints", *joints, "--delay", 0.1)
    with pytest.raises(WheelError, match=said) as raised:
        drive_to_and_fro(f"ros2:{namespace}", RobotConfig(**FOX))
    assert "check ros2.joints" in str(raised.value)


def test_doctor_says_what_a_robot_in_ros_does(
    start_robot: StartRobot, start_program: StartProgram, namespace: str, tmp_path: Path
) -> None:
    start_robot("--joints", *JOINTS, "--rate", 20.0)
    path = tmp_path / "checks.json"
    run(
        start_program(
            *("-m", "acsar_gym", "doctor", f"ros2:{namespace}", "--robot", save(tmp_path)),
            *("--json", path),
        )
    )
    checks = {check["name"]: check for check in json.loads(path.read_text())["checks"]}
    assert f"{namespace}/cmd_vel (geometry_msgs/msg/TwistStamped)" in checks["topics"]["found"]
    assert checks["feedback rate"]["status"] == "warn"
    assert "feedback_rate: 20" in checks["feedback rate"]["fix"]
    assert checks["other commanders"]["status"] == "ok"
    publishers = f"1 of {namespace}/joint_states: {namespace}/foreign_robot"
    assert checks["publishers"]["found"] == publishers

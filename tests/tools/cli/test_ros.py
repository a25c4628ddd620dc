"""`acsar-gym ros ...`: the arguments of ROS."""

from __future__ import annotations

import functools
from typing import Any

import pytest

from acsar_gym import __main__ as entry
from acsar_gym.tools.cli import COMMANDS
from acsar_gym.tools.cli.app import join_ros_arguments

pytestmark = pytest.mark.usefixtures("deadline")

ROS = ("-r", "__ns:=/robot1", "--params-file", "my file.yaml", "-p", 'scene:={"start": [1, 2]}')


@pytest.mark.parametrize(
    ("line", "joined"),
    [
        ("--ros-args -r a:=b -- --link planar --ros-args -p x:=1", "--link planar|-r a:=b -p x:=1"),
        ("--ros-args --link planar", "|--link planar"),
        ("-y --ros-args -r a:=b --ros-args -p x:=1", "-y|-r a:=b -p x:=1"),
    ],
)
def test_join_ros_arguments(line: str, joined: str) -> None:
    words, _, ros = joined.partition("|")
    assert join_ros_arguments(line.split()) == [*words.split(), f"--ros-args={ros}"]


def test_ros_driver_is_the_program_of_the_ros_package(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments: dict[str, Any] = {}
    driver = COMMANDS["ros driver"]

    @functools.wraps(driver.function)
    def note(*_: Any, **options: Any) -> int:
        arguments.update(options)
        return 0

    monkeypatch.setitem(COMMANDS, "ros driver", driver._replace(function=note))
    monkeypatch.setattr("sys.argv", ["/ws/install/acsar_gym/driver", "--ros-args", *ROS])
    with pytest.raises(SystemExit) as ended:
        entry.ros_driver()
    assert ended.value.code == 0
    assert arguments["node"].ros_args == ROS


def test_ros_args_are_unknown_to_other_commands(call: Any) -> None:
    code, _, error = call("policy point_goal --ros-args -p x:=1")
    assert code == 2
    assert "--ros-args" in error

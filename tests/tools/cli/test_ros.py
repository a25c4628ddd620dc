"""`acsar-gym ros ...`: the arguments of ROS."""

from __future__ import annotations

import functools
from typing import Any

import pytest
from cli_tools import Call

from acsar_gym import __main__ as entry
from acsar_gym.tools.cli import COMMANDS

pytestmark = pytest.mark.usefixtures("deadline")

ROS = ("-r", "__ns:=/robot1", "--params-file", "my file.yaml", "-p", "wheel_radius:=0.06")


@pytest.fixture
def driver_options(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The options with which `acsar-gym ros driver` is called. It drives nothing."""
    arguments: dict[str, Any] = {}
    driver = COMMANDS["ros driver"]

    @functools.wraps(driver.function)
    def note(*_: Any, **options: Any) -> int:
        arguments.update(options)
        return 0

    monkeypatch.setitem(COMMANDS, "ros driver", driver._replace(function=note))
    return arguments


@pytest.mark.parametrize(
    ("words", "link", "ros"),
    [
        (("--ros-args", *ROS[:2], "--", "--link", "planar", "--ros-args", *ROS[2:]), "planar", ROS),
        (("--ros-args", "--link", "planar"), "", ("--link", "planar")),
        (
            ("--ros-args", "-p", 'scene:={"start": [1, 2, 0]}'),
            "",
            ("-p", 'scene:={"start": [1, 2, 0]}'),
        ),
        ((), "", ()),
    ],
)
def test_ros_args_reach_the_driver_unchanged(
    call: Call,
    driver_options: dict[str, Any],
    words: tuple[str, ...],
    link: str,
    ros: tuple[str, ...],
) -> None:
    code, _, error = call("ros", "driver", *words)
    assert (code, error) == (0, "")
    assert driver_options["link"] == link
    assert driver_options["node"].ros_args == ros


def test_ros_driver_is_the_program_of_the_ros_package(
    monkeypatch: pytest.MonkeyPatch, driver_options: dict[str, Any]
) -> None:
    monkeypatch.setattr("sys.argv", ["/ws/install/acsar_gym/driver", "--ros-args", *ROS])
    with pytest.raises(SystemExit) as ended:
        entry.ros_driver()
    assert ended.value.code == 0
    assert driver_options["node"].ros_args == ROS


def test_ros_args_are_unknown_to_other_commands(call: Call) -> None:
    code, _, error = call("policy", "point_goal", "--ros-args", "-p", "x:=1")
    assert code == 2
    assert "--ros-args" in error

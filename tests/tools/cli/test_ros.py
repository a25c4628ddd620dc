"""`acsar-gym ros ...`: what is ROS's among its words."""

from __future__ import annotations

import functools
from typing import Any

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym import __main__ as entry
from acsar_gym.tools.cli import COMMANDS
from acsar_gym.tools.cli.app import join_ros_arguments

pytestmark = pytest.mark.usefixtures("deadline")

ROS = ("-r", "__ns:=/robot1", "--params-file", "my file.yaml", "-p", "wheel_radius:=0.06")


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What `acsar-gym ros driver` is called with; it drives nothing."""
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
        (("--link", "planar", "--ros-args", *ROS), "planar", ROS),
        (("--ros-args", *ROS, "--", "--link", "planar"), "planar", ROS),
        (("--ros-args", *ROS[:2], "--", "--link", "planar", "--ros-args", *ROS[2:]), "planar", ROS),
        (("--link", "planar", "--ros-args"), "planar", ()),
        (("--ros-args", "--ros-args", "--", "--link", "planar"), "planar", ()),
        (("--ros-args", "-p", "scene:={\"start\": [1, 2, 0]}"), "", None),
        (("--ros-args", "--link", "planar"), "", ("--link", "planar")),
        ((), "", ()),
    ],
)  # fmt: skip
def test_what_is_ros_own_is_left_as_it_is(
    call: Call,
    given: dict[str, Any],
    words: tuple[str, ...],
    link: str,
    ros: tuple[str, ...] | None,
) -> None:
    code, _, error = call("ros", "driver", *words)
    assert (code, error) == (0, "")
    assert given["link"] == link
    assert given["node"].ros_args == (words[1:] if ros is None else ros)


def test_other_commands_have_no_such_option(call: Call) -> None:
    code, _, error = call("policy", "list", "--ros-args", "-p", "x:=1")
    assert code == 2
    assert "--ros-args" in error
    assert join_ros_arguments(["evaluate", "--", "-r"]) == ["evaluate", "--", "-r"]


def test_a_package_of_ros_has_the_command_as_its_driver(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, Any]
) -> None:
    monkeypatch.setattr("sys.argv", ["/ws/install/acsar_gym/driver", "--ros-args", *ROS])
    with pytest.raises(SystemExit) as ended:
        entry.ros_driver()
    assert ended.value.code == 0
    assert given["node"].ros_args == ROS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--episodes", "0"), "--episodes 0: must be at least 1"),
        (("--once", "--episodes", "3"), "leave out one of them"),
    ],
)
def test_options_of_the_policy_that_cannot_be_are_one_line(
    call: Call, words: tuple[str, ...], said: str
) -> None:
    code, _, error = call("ros", "policy", *words)
    assert code == 2
    assert_one_line(error, said)

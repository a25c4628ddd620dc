"""The package of ROS 2 in assets/ros: its files agree with the commands and nodes behind it."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml
from defusedxml import ElementTree

import acsar_gym
from acsar_gym import RobotConfig
from acsar_gym.links.ros2 import DRIVER_NODE
from acsar_gym.resources import ASSETS
from acsar_gym.ros import node
from acsar_gym.tools.cli import COMMANDS
from acsar_gym.tools.ros import driver

PACKAGE = ASSETS / "ros"
LAUNCHED = sorted((PACKAGE / "launch").iterdir())
ACSAR = RobotConfig.preset("acsar")
COMMENTED = re.compile(r"^    # (\w+): (\S+)$", re.MULTILINE)


@functools.cache
def manifest() -> Any:
    """package.xml."""
    return ElementTree.fromstring((PACKAGE / "package.xml").read_text(encoding="utf-8"))


@functools.cache
def setup() -> dict[str, Any]:
    """What setup.py gives setuptools, but its files."""
    tree = ast.parse((PACKAGE / "setup.py").read_text(encoding="utf-8"))
    calls = (one for one in ast.walk(tree) if isinstance(one, ast.Call))
    (call,) = (one for one in calls if ast.unparse(one.func) == "setup")
    keywords = {keyword.arg: keyword.value for keyword in call.keywords}
    return {
        str(name): ast.literal_eval(value)
        for name, value in keywords.items()
        if name != "data_files"
    }


def programs() -> dict[str, str]:
    """Programs of the package, and the functions that they call."""
    lines = setup()["entry_points"]["console_scripts"]
    return dict(line.split(" = ") for line in lines)


def list_options(command: Callable[..., Any]) -> Iterator[str]:
    """Names of a command's options, those of groups included."""
    for name, kind in get_type_hints(command).items():
        if dataclasses.is_dataclass(kind):
            yield from (one.name for one in dataclasses.fields(kind))
        else:
            yield name


def parameters(file: str) -> dict[str, Any]:
    """Parameters of a file that are for any node."""
    data = yaml.safe_load((PACKAGE / "config" / file).read_text(encoding="utf-8"))
    found = data["/**"]["ros__parameters"]
    assert isinstance(found, dict)
    return found


def test_it_is_an_ament_python_package_of_this_version() -> None:
    assert manifest().attrib["format"] == "3"
    assert manifest().findtext("export/build_type") == "ament_python"
    assert manifest().findtext("name") == "acsar_gym"
    assert manifest().findtext("license") == setup()["license"] == "MIT"
    assert manifest().findtext("version") == setup()["version"] == acsar_gym.__version__
    assert (PACKAGE / "resource" / "acsar_gym").exists()
    for scripts in ("script_dir", "install_scripts"):
        assert f"{scripts} = $base/lib/acsar_gym\n" in (PACKAGE / "setup.cfg").read_text()


def test_it_hides_nothing_of_what_pip_installs() -> None:
    assert setup()["packages"] == setup()["py_modules"] == []
    assert setup()["name"] != "acsar_gym"
    assert {path.name for path in PACKAGE.glob("*.py")} == {"setup.py"}


def test_it_names_all_packages_of_ros_that_are_imported() -> None:
    needed = {one.text for one in manifest().iterfind("exec_depend")}
    tree = ast.parse(Path(node.__file__).read_text(encoding="utf-8"))
    imported = {
        one.module.partition(".")[0]
        for one in ast.walk(tree)
        if isinstance(one, ast.ImportFrom) and one.module and not one.level
    }
    ours = {"__future__", "acsar_gym", "collections", "contextvars", "types", "typing"}
    assert imported - ours <= needed
    launched = {name for path in LAUNCHED for name in re.findall(r"from (\w+)", path.read_text())}
    assert launched <= needed


@pytest.mark.parametrize("program", ["driver", "policy"])
def test_its_programs_are_functions(program: str) -> None:
    module, _, name = programs()[program].partition(":")
    assert callable(getattr(importlib.import_module(module), name))


@pytest.mark.parametrize("path", LAUNCHED, ids=lambda path: path.name)
def test_a_launch_file_starts_programs_with_options_that_they_have(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    compile(text, path, "exec")
    declared = set(re.findall(r'DeclareLaunchArgument\("(\w+)"', text))
    used = set(re.findall(r'LaunchConfiguration\("(\w+)"\)', text))
    (names,) = re.findall(r"for option in (\(.+?\))", text)
    options = set(ast.literal_eval(names))
    assert used | options == declared
    (program,) = re.findall(r'package="acsar_gym",\s+executable="(\w+)"', text)
    assert program in programs()
    if (command := COMMANDS.get(f"ros {program}")) is not None:
        assert options <= set(list_options(command.function))
    (file,) = re.findall(r'"(\w+\.yaml)"', text)
    assert (PACKAGE / "config" / file).exists()


@pytest.mark.parametrize("file", ["driver.yaml", "simulation.yaml"])
def test_parameters_are_those_of_the_driver(file: str) -> None:
    known = {*driver.DRIVER_PARAMETERS, *driver.NODE_PARAMETERS, "cmd_vel_timeout"}
    given = parameters(file)
    assert given.keys() <= known
    assert given["robot"] == "acsar"
    assert given["cmd_vel_timeout"] == ACSAR.firmware.command_timeout
    text = (PACKAGE / "config" / file).read_text(encoding="utf-8")
    for name, value in COMMENTED.findall(text):  # the robot's, which a user may change
        assert yaml.safe_load(value) == getattr(ACSAR, name), name
    without_line = {"name", "serial_port", *driver.COVARIANCES, "scene", "start"}
    named = {*given, *dict(COMMENTED.findall(text)), *without_line}
    assert file != "driver.yaml" or named == known


def test_rviz_shows_what_the_nodes_publish() -> None:
    data = yaml.safe_load((PACKAGE / "rviz" / "acsar.rviz").read_text(encoding="utf-8"))
    manager = data["Visualization Manager"]
    shown = {one["Class"].partition("/")[2]: one for one in manager["Displays"]}
    topics = {name: one["Topic"] for name, one in shown.items() if "Topic" in one}
    assert {name: topic["Value"] for name, topic in topics.items()} == {
        "Odometry": "/odom",
        "LaserScan": "/scan",
        "Path": "/plan",
    }
    assert topics["LaserScan"]["Reliability Policy"] == "Best Effort"
    assert "TF" in shown
    assert manager["Global Options"]["Fixed Frame"] == ACSAR.odom_frame
    (goal,) = (one for one in manager["Tools"] if one["Class"].endswith("/SetGoal"))
    assert goal["Topic"]["Value"] == "/goal_pose"
    published = inspect.getsource(driver)
    assert all(f'publish("{name}"' in published for name in ("odom", "scan"))
    remapped = (PACKAGE / "launch" / "simulation.launch.py").read_text(encoding="utf-8")
    for topic in (*topics.values(), goal["Topic"]):
        assert f'"{topic["Value"][1:]}"' in remapped
    assert DRIVER_NODE == "acsar_driver"

"""The package of ROS 2 in assets/ros: its files agree with the commands and nodes behind it."""

from __future__ import annotations

import ast
import dataclasses
import importlib
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


MANIFEST = ElementTree.fromstring((PACKAGE / "package.xml").read_text(encoding="utf-8"))


def read_setup() -> dict[str, Any]:
    """What setup.py gives setuptools, without its files."""
    tree = ast.parse((PACKAGE / "setup.py").read_text(encoding="utf-8"))
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    (call,) = (node for node in calls if ast.unparse(node.func) == "setup")
    return {
        str(keyword.arg): ast.literal_eval(keyword.value)
        for keyword in call.keywords
        if keyword.arg != "data_files"
    }


PROGRAMS = dict(line.split(" = ") for line in read_setup()["entry_points"]["console_scripts"])
"""Programs of the package, and the functions that they call."""


def list_options(command: Callable[..., Any]) -> Iterator[str]:
    """Names of a command's options, those of groups included."""
    for name, kind in get_type_hints(command).items():
        if dataclasses.is_dataclass(kind):
            yield from (field.name for field in dataclasses.fields(kind))
        else:
            yield name


def read_parameters(file: str) -> dict[str, Any]:
    """Parameters of a file that are for any node."""
    data: Any = yaml.safe_load((PACKAGE / "config" / file).read_text(encoding="utf-8"))
    parameters: dict[str, Any] = data["/**"]["ros__parameters"]
    return parameters


def test_ros_package_is_an_ament_python_package_of_this_version() -> None:
    setup = read_setup()
    assert MANIFEST.attrib["format"] == "3"
    assert MANIFEST.findtext("export/build_type") == "ament_python"
    assert MANIFEST.findtext("name") == "acsar_gym"
    assert MANIFEST.findtext("license") == setup["license"] == "MIT"
    assert MANIFEST.findtext("version") == setup["version"] == acsar_gym.__version__
    assert (PACKAGE / "resource" / "acsar_gym").exists()
    for scripts in ("script_dir", "install_scripts"):
        assert f"{scripts} = $base/lib/acsar_gym\n" in (PACKAGE / "setup.cfg").read_text()
    # It hides nothing of what pip installs.
    assert setup["packages"] == setup["py_modules"] == []
    assert setup["name"] != "acsar_gym"


def test_ros_package_names_all_imported_packages_of_ros() -> None:
    named = {element.text for element in MANIFEST.iterfind("exec_depend")}
    source = Path(node.__file__).read_text(encoding="utf-8")
    imported = set(re.findall(r"^ *from (\w+)[\w.]* import", source, re.M))
    launched = {name for path in LAUNCHED for name in re.findall(r"from (\w+)", path.read_text())}
    ours = {"__future__", "acsar_gym", "collections", "contextvars", "types", "typing"}
    assert (imported | launched) - ours <= named


@pytest.mark.parametrize("path", LAUNCHED, ids=lambda path: path.name)
def test_launch_files_start_programs_with_options_that_they_have(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    compile(text, path, "exec")
    declared = set(re.findall(r'DeclareLaunchArgument\("(\w+)"', text))
    used = set(re.findall(r'LaunchConfiguration\("(\w+)"\)', text))
    (names,) = re.findall(r"for option in (\(.+?\))", text)
    options = set(ast.literal_eval(names))
    assert used | options == declared
    (program,) = re.findall(r'package="acsar_gym",\s+executable="(\w+)"', text)
    module, _, name = PROGRAMS[program].partition(":")
    assert callable(getattr(importlib.import_module(module), name))
    if (command := COMMANDS.get(f"ros {program}")) is not None:
        assert options <= set(list_options(command.function))
    (file,) = re.findall(r'"(\w+\.yaml)"', text)
    assert (PACKAGE / "config" / file).exists()


@pytest.mark.parametrize("file", ["driver.yaml", "simulation.yaml"])
def test_parameter_files_have_parameters_of_the_driver(file: str) -> None:
    names = {*driver.DRIVER_PARAMETERS, *driver.NODE_PARAMETERS, "cmd_vel_timeout"}
    parameters = read_parameters(file)
    assert parameters.keys() <= names
    assert parameters["robot"] == "acsar"
    assert parameters["cmd_vel_timeout"] == ACSAR.firmware.command_timeout

    text = (PACKAGE / "config" / file).read_text(encoding="utf-8")
    commented = dict(COMMENTED.findall(text))  # the robot's, which a user may change
    for name, value in commented.items():
        assert yaml.safe_load(value) == getattr(ACSAR, name), name
    if file == "driver.yaml":
        not_listed = {"name", "serial_port", *driver.COVARIANCES, "scene", "start"}
        assert {*parameters, *commented, *not_listed} == names


def test_rviz_shows_what_the_nodes_publish() -> None:
    data = yaml.safe_load((PACKAGE / "rviz" / "acsar.rviz").read_text(encoding="utf-8"))
    manager = data["Visualization Manager"]
    topics = {
        display["Class"].partition("/")[2]: display["Topic"]["Value"]
        for display in manager["Displays"]
        if "Topic" in display
    }
    assert topics == {"Odometry": "/odom", "LaserScan": "/scan", "Path": "/plan"}
    assert manager["Global Options"]["Fixed Frame"] == ACSAR.odom_frame
    assert DRIVER_NODE == "acsar_driver"

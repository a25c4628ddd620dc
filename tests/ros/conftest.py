"""Everything here needs rclpy and its messages, and is run by `make test-ros` alone."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from ros_tools import Client, ForeignRobot, Program, StartProgram, StartRobot

from acsar_gym import RobotConfig

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
FIRST_DOMAIN = int(os.environ.get("ROS_DOMAIN_ID", "0")) + 50 * WORKER
DOMAINS = itertools.cycle(range(1, 102))
"""Domains whose ports are no ephemeral ones of Linux."""
NUMBERS = itertools.count()


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> int:
    """A domain for each test, so that it hears nothing of nodes of the test before it."""
    number = (FIRST_DOMAIN + next(DOMAINS)) % 102
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros"))
    return number


@pytest.fixture
def namespace() -> str:
    """A namespace for each test."""
    return f"/robot{next(NUMBERS)}"


@pytest.fixture
def programs() -> Iterator[list[Program]]:
    """The test's processes, killed at the end. Their output is shown if the test fails."""
    started: list[Program] = []
    yield started
    for program in started:
        program.kill()
        print(f"{' '.join(program.arguments)}\n{program.printed}", file=sys.stderr)


@pytest.fixture
def start_program(programs: list[Program], tmp_path: Path) -> StartProgram:
    """`start_program("-m", "acsar_gym", ...)` or `start_program("FILE.py", ...)`."""

    def start(*arguments: object) -> Program:
        programs.append(Program(tuple(map(str, arguments)), tmp_path))
        return programs[-1]

    return start


@pytest.fixture
def client(namespace: str, programs: list[Program], deadline: None) -> Iterator[Client]:
    """A node of the test in its namespace."""
    with contextlib.closing(Client(namespace, programs)) as node:
        yield node


@pytest.fixture
def start_robot(
    namespace: str, programs: list[Program], client: Client, tmp_path: Path
) -> StartRobot:
    """`start_robot(delay=0.1)`: foreign_robot.py in the test's namespace, found already."""

    def start(**options: Any) -> ForeignRobot:
        robot = ForeignRobot(tmp_path, namespace=namespace, **options)
        programs.append(robot)
        node = ("foreign_robot", namespace)
        client.wait(
            lambda: node in client.node.get_node_names_and_namespaces() and bool(robot.states),
            "the foreign robot",
        )
        return robot

    return start


@pytest.fixture
def foreign_config() -> RobotConfig:
    """What is known of foreign_robot.py, with the patience that a busy machine needs."""
    return RobotConfig.preset("acsar").with_(
        wheel_radius=0.05,
        wheel_separation=0.3,
        wheel_separation_multiplier=1.0,
        control_rate=50.0,
        connect_timeout=20.0,
        feedback_timeout=5.0,
        watchdog_timeout=2.0,
        ros2={"joints": ["right_front", "left_front", "left_rear", "right_rear"]},
    )

"""Whether a link gets a watchdog, and what is left of it afterwards."""

from __future__ import annotations

import gc
import math
import sys

import pytest
from nursery import ended, first_line, program
from serial_tools import DRIVER, no_leak
from watchdog_tools import TURNING, children

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import watchdog
from acsar_gym.links.serial import SerialLink
from acsar_gym.worlds import Scene

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]


def test_none_means_none(shared_device: str, config: RobotConfig) -> None:
    link = SerialLink(shared_device, config.with_(watchdog_timeout=None))
    assert not link.watched
    link.open()
    assert not link.watched
    assert link.watchdog_pid is None
    assert not children()
    link.write(TURNING)
    link.reset(Scene())
    link.close()


@pytest.mark.parametrize("timeout", [0.0, 0.001, 60.1, 1e7, math.inf])
def test_impossible_timeouts_are_refused(timeout: float) -> None:
    with pytest.raises(ConfigError, match="watchdog_timeout"):
        RobotConfig(watchdog_timeout=timeout)


FEW_FILES = """
import resource
robot.activate()
robot.deactivate()
held = len(os.listdir("/proc/self/fd")) - 1
said = set()
for room in range(100):
    resource.setrlimit(resource.RLIMIT_NOFILE, (held + room, held + 1000))
    try:
        robot.activate()
        break
    except Exception as error:
        said.add(f"{type(error).__name__}: {error}")
    assert len(os.listdir("/proc/self/fd")) == held + 1 if room else True
resource.setrlimit(resource.RLIMIT_NOFILE, (held + 1000, held + 1000))
print(*said, sep="|", flush=True)
"""


def test_too_few_descriptors_are_one_clear_error(shared_device: str) -> None:
    with program(DRIVER + FEW_FILES, shared_device) as process:
        said = first_line(process).split("|")
        assert ended(process) == (0, "")
    assert len(said) > 1
    assert all(one.startswith("LinkError: ") and "ulimit -n" in one for one in said)
    assert "watchdog" in "".join(said)


def test_windows_drives_without(
    shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watchdog, "WATCHDOG_AVAILABLE", False)
    with Robot(open_link(shared_device, config), config) as robot:
        robot.drive(0.2, 0.0)
        assert isinstance(robot.link, SerialLink)
        assert not robot.link.watched


@pytest.mark.parametrize("python", ["/bin/false", "/acsar-missing"])
def test_where_it_cannot_start_nothing_drives(
    python: str, shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", python)
    link = SerialLink(shared_device, config)
    with no_leak(), pytest.raises(LinkError, match="watchdog can't be started") as caught:
        link.open()
    assert "watchdog_timeout=None" in caught.value.fix
    assert not children()
    assert not link.watched


def test_opening_often_leaves_nothing_behind(shared_device: str, config: RobotConfig) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        for _ in range(10):
            link.open()
            assert link.watched
            link.close()
            assert not children()


def test_a_link_that_is_dropped_takes_its_watchdog_along(
    shared_device: str, config: RobotConfig
) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        link.open()
        del link
        gc.collect()
        assert not children()

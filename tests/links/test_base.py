"""What links can do is declared, and a wrapper has the abilities of the link that it wraps."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import SafetyWarning
from acsar_gym.links.base import LinkWrapper
from acsar_gym.links.factory import is_device
from acsar_gym.recording import Recorder
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.worlds import Scene


def test_wrapper_has_each_ability_of_its_link() -> None:
    inner = open_link("bullet")
    wrapper = LinkWrapper(inner)
    wrapper.open()
    wrapper.metered = True
    wrapper.reset(Scene())
    wrapper.advance(0.01)
    assert inner.metered
    assert (wrapper.work, wrapper.truth) == (inner.work, inner.truth)
    assert wrapper.camera is inner.camera is not None
    assert list(wrapper.arrivals) == list(inner.arrivals)
    wrapper.close()


@pytest.mark.parametrize(
    ("url", "is_real"), [("planar", False), ("/dev/ttyUSB0", True), ("ros2:/robot", True)]
)
def test_links_know_whether_their_wheels_are_real(url: str, is_real: bool) -> None:
    assert is_device(url) is LinkWrapper(open_link(url)).is_real is is_real
    assert LinkWrapper(open_link(url)).device == (url if is_real else "")


def test_replay_of_a_real_drive_is_not_real(
    shared_device: str, config: RobotConfig, tmp_path: Path
) -> None:
    """No emergency stop holds it, and no warning reports that a watchdog is missing."""
    config = config.with_(firmware={"command_timeout": None}, watchdog_timeout=60.0)
    tape = tmp_path / "tape.mcap"
    robot = Robot(open_link(shared_device, config), config, recorder=Recorder(tape))
    with pytest.warns(SafetyWarning, match="doesn't stop by itself"):
        robot.activate()
    robot.drive(0.1, 0.0)
    robot.close()

    link = ReplayLink(tape)
    with Robot(link, config) as robot:
        robot.drive(0.1, 0.0)
        assert link.lateness is not None
        assert not link.is_real
        robot.estop()
    with Robot(open_link("planar")) as robot:
        robot.drive(0.1, 0.0)


def test_debug_log_has_each_line_with_its_time(caplog: pytest.LogCaptureFixture) -> None:
    for level in (logging.INFO, logging.DEBUG):
        assert not caplog.records
        caplog.set_level(level, logger="acsar_gym.wire")
        with Robot(open_link("planar")) as robot:
            robot.drive(0.1, 0.0)
            stamp = robot.wire.stamp
    assert f"{stamp:.4f} received b'ap" in caplog.text
    assert f"{stamp - 0.01:.4f} sent b'ap" in caplog.text

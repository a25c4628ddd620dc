"""One contract for every link, the serial one on a pseudo-terminal."""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Callable
from pathlib import Path

import pytest
from serial_tools import no_leak, open_files
from tapes import taped

from acsar_gym import Link, Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.protocol import ZERO, Decoder, Reading, encode
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

PERIOD = 0.01
PATIENCE = 2000
"""Periods to wait for a line."""
TURNING = encode((3.0, 3.0, 3.0, 3.0))
SOUND = ("planar", "bullet", "mujoco", "replay", "serial")
ALL = (*SOUND, *(f"faulty {name}" for name in SOUND))
LIVE = tuple(name for name in ALL if "replay" not in name)
"""A recording can't be opened again or driven elsewhere."""
DORMANT = Faults(dropped_lines=1e-12, late_lines=1e-12)
"""Faults that are configured, but none of them due."""

MakeLink = Callable[[], Link]
Request = pytest.FixtureRequest


@pytest.fixture
def make_link(request: pytest.FixtureRequest, config: RobotConfig, tmp_path: Path) -> MakeLink:
    faulty, _, name = request.param.rpartition(" ")
    if name == "replay":
        tape = taped(tmp_path / "tape.mcap", config)
        if faulty:
            return lambda: FaultyLink(ReplayLink(tape, compare=False), DORMANT)
        return lambda: ReplayLink(tape, compare=False)
    url = request.getfixturevalue("shared_device") if name == "serial" else name
    if faulty:
        return lambda: FaultyLink(open_link(url, config), DORMANT)
    return lambda: open_link(url, config)


every_link = pytest.mark.parametrize("make_link", ALL, indirect=True)
every_live_link = pytest.mark.parametrize("make_link", LIVE, indirect=True)


def answers(link: Link, command: bytes, expected: Callable[[Reading], bool]) -> bool:
    """Whether the expected line comes while a command is held; every line is a valid one."""
    decoder = Decoder()
    for _ in range(PATIENCE):
        link.write(command)
        readings = decoder.feed(link.advance(PERIOD))
        assert not decoder.refused
        if any(map(expected, readings)):
            return True
    return False


def stands(reading: Reading) -> bool:
    return max(abs(speed or 0.0) for speed in reading.speeds) < 0.1


def turns(reading: Reading) -> bool:
    return min(speed or 0.0 for speed in reading.speeds) > 1.0


@every_link
def test_valid_lines_come_back_and_commands_turn_the_wheels(make_link: MakeLink) -> None:
    link = make_link()
    link.open()
    link.reset(Scene())
    assert answers(link, encode(ZERO), stands)
    assert answers(link, TURNING, turns)
    link.close()


@every_live_link
def test_every_reset_begins_at_zero_or_where_the_scene_says(
    make_link: MakeLink, config: RobotConfig
) -> None:
    with Robot(make_link(), config) as robot:
        for start in (0.0, 0.0, 0.0), (1.0, -2.0, 0.5):
            robot.reset(Scene(start=start))
            assert robot.odometry.pose == (0.0, 0.0, 0.0)
            assert max(map(abs, robot.speeds)) < 0.1
            if robot.link.truth:
                assert robot.link.truth.pose == pytest.approx(start, abs=1e-6)
            for _ in range(PATIENCE):
                robot.drive(0.3, 0.0)
                if robot.odometry.pose[0] > 0.01:
                    break
            assert robot.odometry.pose[0] > 0.01


@every_link
def test_the_clock_never_runs_back_and_follows_the_periods(
    make_link: MakeLink, request: Request
) -> None:
    link = make_link()
    assert (link.lateness is not None) == ("serial" in request.node.callspec.id)
    link.open()
    link.reset(Scene())
    stamps = [link.now()]
    for _ in range(60):
        link.write(encode(ZERO))
        link.advance(PERIOD)
        stamps.append(link.now())
        assert link.lateness is None or link.lateness >= 0.0
    link.close()
    steps = [after - before for before, after in itertools.pairwise(stamps)]
    assert min(steps) >= 0.0
    assert stamps[-1] - stamps[0] >= 57 * PERIOD
    median = statistics.median(steps)
    assert median > 0.5 * PERIOD
    assert median < 2.0 * PERIOD or link.lateness is not None


@every_link
def test_opening_twice_and_closing_twice_are_once(make_link: MakeLink, request: Request) -> None:
    with no_leak():
        link = make_link()
        with pytest.raises(LinkError):
            link.write(TURNING)
        link.close()
        for _ in range(1 if "replay" in request.node.callspec.id else 2):
            link.open()
            held = open_files()
            link.open()
            assert open_files() == held
            link.reset(Scene())
            assert answers(link, encode(ZERO), stands)
            link.open()
            link.advance(PERIOD)
            camera = link.camera
            has_camera = re.search("bullet|mujoco", request.node.callspec.id)
            assert (camera is not None) == bool(has_camera)
            assert camera is None or camera.image(4, 3).shape == (3, 4, 3)
            link.close()
            link.close()


@every_link
@pytest.mark.parametrize("use", ["write", "advance"])
def test_using_a_closed_link_is_an_error(make_link: MakeLink, use: str) -> None:
    link = make_link()
    link.open()
    link.reset(Scene())
    link.close()
    with pytest.raises(LinkError, match=r"open|reset"):
        link.write(TURNING) if use == "write" else link.advance(PERIOD)

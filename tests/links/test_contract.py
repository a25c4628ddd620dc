"""One contract for every link, the serial one on a pseudo-terminal."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable
from pathlib import Path

import pytest
from recording_tools import taped
from serial_tools import no_leak, open_files

from acsar_gym import Link, Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.protocol import ZERO, Decoder, encode
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


@pytest.fixture
def make_link(request: pytest.FixtureRequest, config: RobotConfig, tmp_path: Path) -> MakeLink:
    faulty, _, name = request.param.rpartition(" ")
    url = request.getfixturevalue("shared_device") if name == "serial" else name
    tape = taped(tmp_path / "tape.mcap", config) if name == "replay" else None

    def make() -> Link:
        link = open_link(url, config) if tape is None else ReplayLink(tape, compare=False)
        return FaultyLink(link, DORMANT) if faulty else link

    return make


every_link = pytest.mark.parametrize("make_link", ALL, indirect=True)
every_live_link = pytest.mark.parametrize("make_link", LIVE, indirect=True)


def answers(link: Link, command: bytes) -> bool:
    """Whether the wheels follow a command. Every line must be valid."""
    decoder = Decoder()
    for _ in range(PATIENCE):
        link.write(command)
        for reading in decoder.feed(link.advance(PERIOD)):
            speeds = reading.over(ZERO)
            if min(speeds) > 1.0 if command == TURNING else max(map(abs, speeds)) < 0.1:
                return True
        assert not decoder.refused
    return False


@every_link
def test_link_sends_valid_lines_and_commands_turn_the_wheels(make_link: MakeLink) -> None:
    link = make_link()
    link.open()
    link.reset(Scene())
    assert answers(link, encode(ZERO))
    assert answers(link, TURNING)
    link.close()


@every_live_link
def test_link_reset_starts_at_rest_where_the_scene_is(
    make_link: MakeLink, config: RobotConfig
) -> None:
    with Robot(make_link(), config) as robot:
        for start in ((0.0, 0.0, 0.0), (1.0, -2.0, 0.5)):
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
def test_link_clock_follows_the_periods_and_never_runs_back(make_link: MakeLink) -> None:
    link = make_link()
    link.open()
    link.reset(Scene())
    stamps = [link.now()]
    for _ in range(60):
        link.write(encode(ZERO))
        link.advance(PERIOD)
        stamps.append(link.now())
        assert (link.lateness is not None) == link.is_real
        assert link.lateness is None or link.lateness >= 0.0
    link.close()

    steps = [end - start for start, end in itertools.pairwise(stamps)]
    assert min(steps) >= 0.0
    assert stamps[-1] - stamps[0] >= 57 * PERIOD
    assert 0.5 < statistics.median(steps) / PERIOD < (math.inf if link.is_real else 2.0)


@every_link
def test_link_opened_and_closed_twice_is_an_error_to_use_while_closed(make_link: MakeLink) -> None:
    with no_leak():
        link = make_link()
        with pytest.raises(LinkError):
            link.write(TURNING)
        link.close()

        for _ in range(1 if link.scans else 2):
            link.open()
            files = open_files()
            link.open()
            assert open_files() == files
            link.reset(Scene())
            assert answers(link, encode(ZERO))
            link.close()
            link.close()
            with pytest.raises(LinkError, match=r"open|reset"):
                link.write(TURNING)
            with pytest.raises(LinkError, match=r"open|reset"):
                link.advance(PERIOD)

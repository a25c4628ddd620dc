"""Boards that behave differently, over pseudo-terminals and in simulated time."""

from __future__ import annotations

import os
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import serial_tools
from serial_tools import TIMEOUT, Emulated, cli

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import Decoder, Speeds, encode
from acsar_gym.tools.emulation import quirks

pytestmark = [pytest.mark.xdist_group("serial"), pytest.mark.usefixtures("deadline")]

SPEEDS = (4.0, 1.0, 2.0, 3.0)
"""A left turn, with another speed for each wheel [rad/s]."""
LINE = encode(SPEEDS, trailing_comma=False)
QUIRKS = (
    "at-comma",
    "no-comma",
    "unpadded",
    "padded-space",
    "reversed-encoder=b",
    "reversed-motor=b",
    "swapped-encoders",
    "swapped-motors",
    "dead-wheel=c",
    "dead-encoder=c",
    "frozen=0.3",
    "resets=0.3",
    "command-timeout=0.1",
    "no-timeout",
    "feedback-rate=50",
)
DRIVEN, SILENT = 80, 160
"""After so many lines of feedback a client stops commanding, and after so many it goes."""


@dataclass
class Heard:
    """What a client heard of a board, and what its robot did."""

    driven: bytes
    """While commands were sent."""
    after: bytes
    """When they had ended."""
    emulated: Emulated

    @property
    def stopped(self) -> bool:
        """Whether the board has stopped in mid-line."""
        return bool(self.driven) and not self.driven.endswith(b"\n")

    def talk(self, port: int) -> bool:
        """Send a command, or none any more, and listen; returns whether that goes on."""
        lines = (self.driven + self.after).count(b"\n")
        data = read(port)
        if lines >= DRIVEN:
            self.after += data
            return lines < SILENT
        os.write(port, LINE)
        self.driven += data
        return bool(data) or not self.stopped

    @property
    def turned(self) -> float:
        """How far the robot really turned [rad]."""
        return self.emulated.poses()[-1][2]

    @property
    def speeds(self) -> Speeds:
        """The newest speeds while commands were sent."""
        return rounded(self.driven)

    @property
    def last(self) -> Speeds:
        """The speeds at the end."""
        return rounded(self.after)


def rounded(data: bytes) -> Speeds:
    """The speeds of the newest line, to 0.5 rad/s."""
    *_, newest = Decoder().feed(data)
    a, b, c, d = (round(2.0 * (speed or 0.0)) / 2.0 for speed in newest.speeds)
    return a, b, c, d


def quirky(*names: str) -> tuple[quirks.QuirkyLink, SimulatedLink]:
    """A board in simulated time, and its robot."""
    found = quirks.parse_quirks(names)
    config = quirks.apply_to_config(found, RobotConfig())
    link = SimulatedLink(config, partial(PlanarBody, config))
    link.open()
    return quirks.QuirkyLink(link, config, found), link


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Heard]]:
    """All boards at once, each in a process of its own, driven by the same commands."""
    folder = tmp_path_factory.mktemp("quirks")
    boards = {
        quirk: serial_tools.start(folder / f"{number}.jsonl", "--quirk", quirk)
        for number, quirk in enumerate(QUIRKS)
    }
    try:
        yield talked(boards)
    finally:
        for board in boards.values():
            board.end()


def talked(boards: dict[str, Emulated]) -> dict[str, Heard]:
    """Command all boards for a while, then be silent; what was heard of each."""
    flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
    ports = {quirk: os.open(board.device, flags) for quirk, board in boards.items()}
    for port in ports.values():
        termios.tcflush(port, termios.TCIFLUSH)
    found = {quirk: Heard(b"", b"", board) for quirk, board in boards.items()}
    deadline = time.monotonic() + TIMEOUT
    talking = set(boards)
    while talking and time.monotonic() < deadline:
        talking = {quirk for quirk in talking if found[quirk].talk(ports[quirk])}
        time.sleep(0.02)
    for port in ports.values():
        os.close(port)
    return found


def read(port: int) -> bytes:
    try:
        return os.read(port, 65536)
    except BlockingIOError:
        return b""


def test_a_board_that_takes_values_at_their_commas(heard: dict[str, Heard]) -> None:
    assert heard["at-comma"].speeds == (4.0, 1.0, 2.0, 0.0)


@pytest.mark.parametrize(("comma", "last"), [(True, 0.0), (False, 3.0)])
def test_a_board_that_misses_the_value_before_a_trailing_comma(comma: bool, last: float) -> None:
    board, link = quirky("no-comma")
    for _ in range(200):
        board.write(encode(SPEEDS, trailing_comma=comma))
        board.advance(0.005)
    assert link.body is not None
    assert link.body.wheel_speeds == pytest.approx((4.0, 1.0, 2.0, last), abs=0.01)


@pytest.mark.parametrize(("quirk", "part"), [("unpadded", b",bp1.0"), ("padded-space", b",bp 1.0")])
def test_a_board_with_numbers_of_its_own(quirk: str, part: bytes, heard: dict[str, Heard]) -> None:
    assert heard[quirk].speeds == SPEEDS
    assert part in heard[quirk].driven


def test_wiring(heard: dict[str, Heard]) -> None:
    assert heard["reversed-encoder=b"].speeds == (4.0, -1.0, 2.0, 3.0)
    assert heard["reversed-motor=b"].speeds == (4.0, -1.0, 2.0, 3.0)
    assert heard["swapped-encoders"].speeds == (1.0, 4.0, 3.0, 2.0)
    assert heard["swapped-motors"].speeds == (1.0, 4.0, 3.0, 2.0)
    assert heard["swapped-encoders"].turned > 0.1
    assert heard["swapped-motors"].turned < -0.1


def test_dead_parts(heard: dict[str, Heard]) -> None:
    assert heard["dead-wheel=c"].speeds == heard["dead-encoder=c"].speeds == (4.0, 1.0, 0.0, 3.0)


@pytest.mark.parametrize(
    ("quirk", "speeds"),
    [
        ("reversed-encoder=b", SPEEDS),
        ("reversed-motor=b", (4.0, -1.0, 2.0, 3.0)),
        ("swapped-encoders", SPEEDS),
        ("swapped-motors", (1.0, 4.0, 3.0, 2.0)),
        ("dead-wheel=c", (4.0, 1.0, 0.0, 3.0)),
        ("dead-encoder=c", SPEEDS),
        ("runaway=b", (4.0, 15.4, 2.0, 3.0)),
        ("feedback-factor=1.5", SPEEDS),
    ],
)
def test_what_the_wheels_really_do(quirk: str, speeds: Speeds) -> None:
    board, link = quirky(quirk)
    for _ in range(200):
        board.write(LINE)
        board.advance(0.005)
    assert link.body is not None
    assert link.body.wheel_speeds == pytest.approx(speeds, abs=0.01)


@pytest.mark.parametrize(
    ("quirk", "speeds"),
    [("runaway=b", (4.0, -15.4, 2.0, 3.0)), ("feedback-factor=1.5", (6.0, 1.5, 3.0, 4.5))],
)
def test_what_an_encoder_in_the_loop_and_other_units_report(quirk: str, speeds: Speeds) -> None:
    board, _ = quirky(quirk)
    heard = b""
    for _ in range(200):
        board.write(LINE)
        heard += board.advance(0.005)
    *_, newest = Decoder().feed(heard)
    assert newest.speeds == pytest.approx(speeds, abs=0.15)  # of a count


@pytest.mark.parametrize("quirk", ["frozen=0.3", "resets=0.3"])
def test_a_board_that_stops_in_mid_line(quirk: str, heard: dict[str, Heard]) -> None:
    decoder = Decoder()
    decoder.feed(heard[quirk].driven)
    assert 1 <= decoder.lines < DRIVEN
    assert not decoder.refused
    assert decoder.rest
    assert heard[quirk].stopped


def test_command_time_outs(heard: dict[str, Heard]) -> None:
    assert heard["command-timeout=0.1"].last == (0.0,) * 4
    assert heard["no-timeout"].last == SPEEDS


def test_feedback_rate(heard: dict[str, Heard]) -> None:
    assert heard["feedback-rate=50"].speeds == SPEEDS
    board, _ = quirky("feedback-rate=50")
    assert sum(board.advance(0.005).count(b"\n") for _ in range(200)) in (49, 50)


def test_a_board_that_resets_answers_again() -> None:
    board, _ = quirky("resets=0.5")
    decoder, silent, longest = Decoder(), 0, 0
    for _ in range(900):
        board.write(LINE)
        data = board.advance(0.005)
        silent = 0 if data else silent + 1
        longest = max(longest, silent)
        decoder.feed(data)
    assert 290 <= longest <= 310
    assert decoder.cut == 2
    assert not decoder.refused


@pytest.mark.parametrize(
    ("quirk", "said"),
    [
        ("at-coma", "did you mean 'at-comma'"),
        ("dead-wheel", "dead-wheel=WHEEL"),
        ("dead-wheel=ab", "one of a, b, c, d"),
        ("reversed-encoder=x", "one of a, b, c, d"),
        ("runaway=", "one of a, b, c, d"),
        ("feedback-factor=0", "feedback-factor=NUMBER"),
        ("command-timeout=soon", "command-timeout=NUMBER"),
        ("frozen=-1", "more than 0"),
        ("feedback-rate=nan", "more than 0"),
        ("at-comma=1", "has no value"),
    ],
)
def test_bad_quirks_are_one_error(quirk: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        quirks.parse_quirks([quirk])
    assert said in str(caught.value)


def test_the_command_line_refuses_an_unknown_quirk(tmp_path: Path) -> None:
    done = cli("emulate", "--quirk", "unpaded", "--log", tmp_path / "log")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "did you mean 'unpadded'" in done.stderr

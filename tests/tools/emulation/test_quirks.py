"""Boards that behave differently, in simulated time; one over a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from board_tools import board
from numpy.typing import NDArray
from serial_tools import StartEmulator, cli

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.links import Link
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.protocol import Decoder, Speeds, encode
from acsar_gym.tools.emulation.quirks import QuirkyLink, make_link, parse_quirks

Floats = NDArray[np.float64]
SPEEDS = (4.0, 1.0, 2.0, 3.0)
"""A left turn, with another speed for each wheel [rad/s]."""
LOOP = 0.005


def drive(
    link: QuirkyLink, seconds: float = 1.0, *, comma: bool = False, says: bool = True
) -> bytes:
    """What the board sends while it is commanded, or while nothing is."""
    heard = b""
    for _ in range(round(seconds / LOOP)):
        if says:
            link.write(encode(SPEEDS, trailing_comma=comma))
        heard += link.advance(LOOP)
    return heard


def newest(heard: bytes) -> Speeds:
    """The speeds that the last line reports."""
    *_, reading = Decoder().feed(heard)
    a, b, c, d = (speed or 0.0 for speed in reading.speeds)
    return a, b, c, d


def turning(link: Link) -> Speeds:
    """The speeds of the wheels."""
    inner = link.link if isinstance(link, QuirkyLink) else link
    assert isinstance(inner, SimulatedLink)
    assert inner.body is not None
    return inner.body.wheel_speeds


@pytest.mark.parametrize(
    ("quirk", "reported", "real"),
    [
        ("at-comma", (4.0, 1.0, 2.0, 0.0), (4.0, 1.0, 2.0, 0.0)),
        ("unpadded", SPEEDS, SPEEDS),
        ("padded-space", SPEEDS, SPEEDS),
        ("reversed-encoder=b", (4.0, -1.0, 2.0, 3.0), SPEEDS),
        ("reversed-motor=b", (4.0, -1.0, 2.0, 3.0), (4.0, -1.0, 2.0, 3.0)),
        ("swapped-encoders", (1.0, 4.0, 3.0, 2.0), SPEEDS),
        ("swapped-motors", (1.0, 4.0, 3.0, 2.0), (1.0, 4.0, 3.0, 2.0)),
        ("dead-wheel=c", (4.0, 1.0, 0.0, 3.0), (4.0, 1.0, 0.0, 3.0)),
        ("dead-encoder=c", (4.0, 1.0, 0.0, 3.0), SPEEDS),
        ("runaway=b", (4.0, -15.4, 2.0, 3.0), (4.0, 15.4, 2.0, 3.0)),
        ("feedback-factor=1.5", (6.0, 1.5, 3.0, 4.5), SPEEDS),
        ("feedback-rate=50", SPEEDS, SPEEDS),
    ],
)
def test_what_a_board_reports_and_what_the_wheels_do(
    quirk: str, reported: Speeds, real: Speeds
) -> None:
    link = board(quirk)
    assert newest(drive(link)) == pytest.approx(reported, abs=0.15)  # of a count
    assert turning(link) == pytest.approx(real, abs=0.01)


def answer(quirk: str, speeds: list[float], lag: float = 0.1) -> Floats:
    """Speed of the first wheel in each loop, where each command holds for a second [rad/s]."""
    config = RobotConfig(motor={"time_constant": lag, "acceleration": 1e4})
    link = make_link("planar", config, parse_quirks([quirk]))
    link.open()
    turned = []
    for speed in np.repeat(speeds, round(1.0 / LOOP)).tolist():
        link.write(encode((speed,) * 4))
        link.advance(LOOP)
        turned.append(turning(link)[0])
    return np.array(turned).reshape(len(speeds), -1)


def test_motors_that_no_config_describes() -> None:
    forward, backward = answer("backward-gain=0.85", [4.0, -4.0])[:, -1]
    assert (forward, backward) == pytest.approx((4.0, -3.4), abs=1e-3)
    (swings,) = answer("overshoot=0.2", [4.0], lag=0.05)
    assert swings.max() == pytest.approx(4.8, abs=0.15)
    assert swings[-1] == pytest.approx(4.0, abs=0.01)
    up, down, more = answer("reversal-hold=0.3", [4.0, -4.0, -6.0], lag=0.01)
    assert np.flatnonzero(np.abs(down) > 1.0)[[0, -1]].tolist() == [0, 199]
    assert np.abs(down[20:58]).max() < 0.01
    assert down[80] == pytest.approx(-4.0, abs=0.01)
    assert min(up[20], -more[20]) > 3.9


def test_numbers_and_rates_of_its_own() -> None:
    assert b",bp1." in drive(board("unpadded"))
    assert b",bp 1." in drive(board("padded-space"))
    assert drive(board("feedback-rate=50")).count(b"\n") in (49, 50)


def test_boards_that_send_commands_back() -> None:
    sent = encode(SPEEDS, trailing_comma=False)
    heard = drive(board("echo", "feedback-rate=50")).splitlines(keepends=True)
    assert 195 <= heard.count(sent) <= 200
    late = board("echo=0.1")
    late.write(sent)
    assert sent not in drive(late, 0.09, says=False)
    assert sent in drive(late, 0.02, says=False)
    *_, before, last = drive(board("echo-newest", "feedback-rate=50")).splitlines(keepends=True)
    assert before == sent != last
    assert newest(drive(board("set-points", "dead-wheel=a"), 0.05)) == SPEEDS


def test_boards_with_other_letters_and_old_lines() -> None:
    assert b"AP04.0" in drive(board("upper-case"))
    assert b",b+01.0" in drive(board("signs"))
    deaf = board("upper-case-commands")
    drive(deaf)
    assert turning(deaf) == (0.0,) * 4
    deaf.write(encode(SPEEDS).upper())
    drive(deaf, 0.3, says=False)
    assert turning(deaf) == pytest.approx(SPEEDS, abs=0.3)
    stale = board("stale=1")
    drive(stale, 0.9)
    assert len(set(drive(stale, 0.4).splitlines()[12:38])) == 1


@pytest.mark.parametrize(
    ("quirk", "comma", "silence", "speeds"),
    [
        ("no-comma", False, 0.0, SPEEDS),
        ("no-comma", True, 0.0, (*SPEEDS[:3], 0.0)),
        ("command-timeout=0.1", False, 2.0, (0.0,) * 4),
        ("no-timeout", False, 2.0, SPEEDS),
    ],
)
def test_missed_values_and_command_time_outs(
    quirk: str, comma: bool, silence: float, speeds: Speeds
) -> None:
    link = board(quirk)
    drive(link, comma=comma)
    drive(link, silence, says=False)
    assert turning(link) == pytest.approx(speeds, abs=0.01)


def test_a_board_that_stops_in_mid_line() -> None:
    decoder = Decoder()
    link = board("frozen=0.3")
    decoder.feed(drive(link, 5.0))
    assert 28 <= decoder.lines <= 31
    assert not decoder.refused
    assert decoder.rest
    assert turning(link) == pytest.approx((0.0,) * 4, abs=0.01)


def test_a_board_that_resets_answers_again() -> None:
    link = board("resets=0.5")
    decoder, silent, longest = Decoder(), 0, 0
    for _ in range(900):
        data = drive(link, LOOP)
        silent = 0 if data else silent + 1
        longest = max(longest, silent)
        decoder.feed(data)
    assert 290 <= longest <= 310
    assert decoder.cut == 2
    assert not decoder.refused


@pytest.mark.parametrize(
    ("quirk", "said"),
    [
        ("at-coma", "at-comma"),
        ("dead-wheel", "dead-wheel=WHEEL"),
        ("dead-wheel=ab", "a, b, c, d"),
        ("reversed-encoder=x", "a, b, c, d"),
        ("runaway=", "a, b, c, d"),
        ("feedback-factor=0", "feedback-factor=NUMBER"),
        ("command-timeout=soon", "command-timeout=NUMBER"),
        ("frozen=-1", "frozen=NUMBER"),
        ("feedback-rate=nan", "feedback-rate=NUMBER"),
        ("at-comma=1", "at-comma"),
    ],
)
def test_bad_quirks_are_one_error(quirk: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_quirks([quirk])


@pytest.mark.usefixtures("deadline")
def test_an_emulator_has_quirks(
    start_emulator: StartEmulator, config: RobotConfig, tmp_path: Path
) -> None:
    link = open_link(start_emulator("--quirk", "unpadded", "swapped-motors").device, config)
    link.open()
    heard = b""
    while b"ap0.00,bp0.00" not in heard:
        heard += link.advance(config.period)
    link.close()
    done = cli("emulate", "--quirk", "unpaded", "--log", tmp_path / "log")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "unpadded" in done.stderr

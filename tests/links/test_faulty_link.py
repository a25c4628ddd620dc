"""Faults in a link: of lines, encoders, wheels, boards, supplies and cables."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import LinkLostError
from acsar_gym.links.faults import FaultSeed, FaultyLink
from acsar_gym.physics.body import Camera, Image
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")


PERIOD = 0.01
LINES = 3000
EVERYTHING: dict[str, Any] = {
    "dropped_lines": 0.05,
    "duplicated_lines": 0.05,
    "cut_lines": 0.05,
    "corrupted_lines": 0.05,
    "late_lines": 0.05,
    "garbage_rate": 2.0,
    "stuck_encoders": 1,
    "reversed_encoders": 1,
    "dead_wheels": 1,
    "board_reset_rate": 0.1,
    "brown_out_rate": 0.2,
}


def numbered(number: int) -> bytes:
    """A line that says which one it is."""
    return encode((number // 90 + 1.0, number % 90 + 1.0, 4.0, 5.0))


TURNING = encode((3.0, 3.0, 3.0, 3.0))
"""Length of a line [bytes]."""


def sent(ticks: int = LINES) -> list[bytes]:
    return [numbered(tick) for tick in range(ticks)]


def split_lines(stream: bytes) -> list[bytes]:
    return stream.splitlines(keepends=True)


class Board:
    """Says one numbered line a period, and keeps what it hears and when."""

    truth: GroundTruth | None = None
    lateness: float | None = 0.004
    device = "/dev/board0"

    def __init__(self) -> None:
        self.ticks = itertools.count()
        self.heard: list[tuple[float, bytes]] = []
        self.clock = 0.0
        self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1

    def reset(self, scene: Scene) -> None:
        self.heard.clear()
        self.ticks = itertools.count()
        self.clock = 10.0

    def write(self, data: bytes) -> None:
        self.heard.append((self.clock, data))

    def advance(self, period: float) -> bytes:
        self.clock += period
        return numbered(next(self.ticks))

    def now(self) -> float:
        return self.clock

    @property
    def camera(self) -> Camera | None:
        return self

    def image(self, width: int, height: int) -> Image:
        return np.zeros((height, width, 3), np.uint8)

    def close(self) -> None:
        self.closed += 1

    def received(self) -> bytes:
        return b"".join(data for _, data in self.heard)

    def lines(self) -> list[bytes]:
        return split_lines(self.received())


def drive(link: FaultyLink, ticks: int = LINES, *, reset: bool = True) -> list[bytes]:
    """What is heard in each period, while numbered commands are sent."""
    if reset:
        link.open()
        link.reset(Scene())
    heard = []
    for tick in range(ticks):
        link.write(numbered(tick))
        heard.append(link.advance(PERIOD))
    return heard


def on_board(seed: FaultSeed = 0, **faults: Any) -> tuple[FaultyLink, Board]:
    board = Board()
    return FaultyLink(board, faults, seed), board


def planar(config: RobotConfig, seed: FaultSeed = 0, **faults: Any) -> FaultyLink:
    return FaultyLink(open_link("planar", config), faults, seed)


def readings(heard: list[bytes]) -> list[tuple[float | None, ...]]:
    return [reading.speeds for reading in Decoder().feed(b"".join(heard))]


AS_TURNED = (3.0, 3.0, 3.0, 3.0)


def test_a_stuck_encoder_repeats_its_reading() -> None:
    link, _ = on_board(stuck_encoders="b", wheel_faults_at=0.05)
    stuck = [speeds[1] for speeds in readings(drive(link, 10))]
    assert stuck == [1.0, 2.0, 3.0, 4.0, *[4.0] * 6]
    link, _ = on_board(stuck_encoders="b")
    assert {speeds[1] for speeds in readings(drive(link, 10))} == {0.0}


def test_a_reversed_encoder_says_the_opposite(config: RobotConfig) -> None:
    link, _ = on_board(reversed_encoders="d")
    assert {speeds[2:] for speeds in readings(drive(link, 10))} == {(4.0, -5.0)}
    assert link.wheels.reversed == "d"
    link = planar(config, reversed_encoders="b")
    with Robot(link, config) as robot:
        for _ in range(50):
            robot.tick(AS_TURNED)
        assert robot.speeds == pytest.approx((3.0, -3.0, 3.0, 3.0), abs=0.2)


def test_a_dead_wheel_really_stands(config: RobotConfig) -> None:
    with Robot(planar(config, dead_wheels="ad"), config) as robot:
        for _ in range(100):
            robot.tick(AS_TURNED)
        assert robot.speeds == pytest.approx((0.0, 3.0, 3.0, 0.0), abs=0.2)
        assert robot.link.truth is not None
        assert robot.link.truth.pose[2] < -0.1  # the right wheels drag it around


@pytest.mark.parametrize("name", ["board_reset", "brown_out"])
def test_a_board_that_is_down_says_and_hears_nothing(name: str) -> None:
    link, board = on_board(0, **{f"{name}_at": 0.5, "reset_time": 0.4, "brown_out_time": 0.4})
    heard = drive(link, 200)
    assert heard[:49] == sent(49)
    assert not any(heard[49:89])
    assert heard[89:] == sent(200)[89:]
    assert link.injected == {name: 1}
    assert set(readings([data for _, data in board.heard[50:90]])) == {ZERO}
    assert board.lines()[-110:] == sent(200)[-110:]


def test_a_pulled_cable_is_a_lost_link(config: RobotConfig) -> None:
    link = planar(config, unplug_at=0.5, replug_time=0.7)
    robot = Robot(link, config)
    robot.activate()
    for _ in range(100):
        robot.drive(0.0, 0.0)
    start = link.now()
    with pytest.raises(LinkLostError, match="robot0: lost while in use"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
    assert link.now() == pytest.approx(start + 0.5)
    assert link.injected == {"unplug": 1}
    for use in (lambda: link.write(TURNING), lambda: link.advance(PERIOD)):
        with pytest.raises(LinkLostError, match="open"):
            use()
    with pytest.raises(LinkLostError):
        link.reset(Scene())
    link.open()
    assert link.now() == pytest.approx(start + 1.2)
    assert link.device == "robot1"
    robot.reset(Scene())
    for _ in range(40):
        robot.drive(0.3, 0.0)
    assert robot.odometry.pose[0] > 0.05
    with pytest.raises(LinkLostError, match="robot1"):
        for _ in range(20):
            robot.drive(0.3, 0.0)


@pytest.mark.parametrize(
    "name", ["dropped_lines", "duplicated_lines", "cut_lines", "corrupted_lines", "late_lines"]
)
def test_shares_of_lines(name: str) -> None:
    for direction in ("feedback", "commands"):
        link, board = on_board(0, direction=direction, lateness=0.0, **{name: 0.1})
        feedback = drive(link)
        assert link.injected[name] / LINES == pytest.approx(0.1, abs=0.02)
        assert set(link.injected) == {name}
        ill, sound = b"".join(feedback), board.received()
        if direction == "commands":
            ill, sound = sound, ill
        assert sound == b"".join(sent())
        changed = set(sent()) - set(split_lines(ill))
        shown = {"dropped_lines": 0.1, "cut_lines": 0.2, "corrupted_lines": 0.1}.get(name, 0.0)
        assert len(changed) / LINES == pytest.approx(shown, abs=0.035 if shown else 0.0)


def test_late_lines_hold_up_those_behind_and_keep_their_order() -> None:
    link, board = on_board(late_lines=0.05, lateness=0.03)
    heard = drive(link)
    assert split_lines(b"".join(heard)) == sent(len(split_lines(b"".join(heard))))
    assert board.lines() == sent(len(board.lines()))
    assert b"" in heard
    commands = [(round((stamp - 10.0) / PERIOD), data) for stamp, data in board.heard]
    for arrivals in (enumerate(heard), commands):
        ticks = [tick for tick, piece in arrivals for _ in split_lines(piece)]
        assert {tick - number for number, tick in enumerate(ticks)} == {0, 1, 2, 3}


@pytest.mark.parametrize(
    "faults",
    [
        None,
        {"lateness": 1.0, "reset_time": 1.0},
        {**EVERYTHING, "episodes": 0.0},
        {"dropped_lines": 1e-12, "unplug_at": 1e9, "wheel_faults_at": 1e9, "dead_wheels": 2},
    ],
    ids=["none", "only how long", "sound episodes", "none due"],
)
def test_without_faults_the_bytes_are_the_same(faults: Any) -> None:
    board = Board()
    link = FaultyLink(board, faults, seed=3)
    assert drive(link, 100) == board.lines() == sent(100)
    assert not link.injected
    if faults is None:
        for piece in (b"ap1", b"", b"2.50\r", b"\n\xff"):
            link.write(piece)
        assert [data for _, data in board.heard[100:]] == [b"ap1", b"", b"2.50\r", b"\n\xff"]


def test_episodes_differ_and_their_seed_repeats_them(config: RobotConfig) -> None:
    link = planar(config, 4, **EVERYTHING)
    first, second = drive(link, 300), drive(link, 300)
    assert first != second
    for again in (planar(config, 4, **EVERYTHING), link):
        again.seed(np.int64(4))
        assert [drive(again, 300), drive(again, 300)] == [first, second]
    for other in (5, None, None):
        assert drive(planar(config, other, **EVERYTHING), 300) != first

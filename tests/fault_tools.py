"""A board that says numbered lines, and links to it on which things go wrong."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from acsar_gym import RobotConfig, open_link
from acsar_gym.links.faults import FaultSeed, FaultyLink
from acsar_gym.physics.body import Camera, GroundTruth, Image
from acsar_gym.protocol import Decoder, encode
from acsar_gym.worlds import Scene

PERIOD = 0.01

LINES = 3000

TURNING = encode((3.0, 3.0, 3.0, 3.0))

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


def sent(ticks: int = LINES) -> list[bytes]:
    return [numbered(tick) for tick in range(ticks)]


def lines_of(stream: bytes) -> list[bytes]:
    return stream.splitlines(keepends=True)


def board_lines(board: Board) -> list[bytes]:
    return lines_of(board.received())


def readings(heard: list[bytes]) -> list[tuple[float | None, ...]]:
    return [reading.speeds for reading in Decoder().feed(b"".join(heard))]

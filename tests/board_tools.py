"""Boards with quirks in simulated time, for tests of the doctor."""

from __future__ import annotations

from collections.abc import Sequence

import quirks

from acsar_gym import Link, RobotConfig, open_link
from acsar_gym.tools.commission.board_checks import BoardExamination
from acsar_gym.tools.commission.checks import Check
from acsar_gym.tools.commission.wiring import parse_seen


def board(*names: str, robot: RobotConfig | None = None) -> quirks.QuirkyLink:
    """A board in simulated time that behaves so, with the robot's own parameters."""
    found = quirks.parse_quirks(names)
    config = quirks.apply_to_config(found, robot or RobotConfig())
    return quirks.QuirkyLink(open_link("planar", config), config, found)


def examined(
    link: Link, saw: Sequence[str] | None = None, config: RobotConfig | None = None
) -> tuple[BoardExamination, dict[str, Check]]:
    """The doctor's examination, and its rows by name; the robot is taken to be the usual one."""
    seen = None if saw is None else parse_seen(saw)
    board = BoardExamination(config or RobotConfig(), spin=True, seen=seen)
    return board, {row.name: row for row in board.run(link)}


class Sibling(Link):
    """A board as code of sibling robots has it, with integer arithmetic and nothing of ours.

    It takes a value at its comma, and what stands before it since the last comma, line ends
    included, belongs to it. Numbers are unpadded. It is silent for 1.5 s after power-up, then
    sends 50 lines a second, and stops the motors 500 ms after the last value.
    """

    def __init__(self) -> None:
        self.us = 0
        self.token = b""
        self.wanted = [0, 0, 0, 0]
        self.speed = [0, 0, 0, 0]
        self.heard = -1_000_000
        self.line = 1_500_000

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """Nothing to close."""

    def reset(self, scene: object) -> None:
        """Nothing to reset."""

    def now(self) -> float:
        return self.us / 1e6

    def write(self, data: bytes) -> None:
        for byte in data:
            if byte != ord(","):
                self.token = (self.token + bytes([byte]))[:40]
                continue
            text, self.token = self.token.strip(), b""
            if text[:1] in (b"a", b"b", b"c", b"d") and text[1:2] in (b"p", b"n"):
                number = text[2:].split()[0] if text[2:].split() else b"0"
                value = int(float(number) * 100) * (1 if text[1:2] == b"p" else -1)
                self.wanted[b"abcd".index(text[:1])] = value
                self.heard = self.us

    def advance(self, period: float) -> bytes:
        out = b""
        for _ in range(round(period * 1000)):
            self.us += 1000
            if self.us - self.heard > 500_000:
                self.wanted = [0, 0, 0, 0]
            if self.us % 10_000 == 0:
                for k, wanted in enumerate(self.wanted):
                    drive = 0 if abs(wanted) < 90 else wanted
                    self.speed[k] += (drive * 16 - self.speed[k]) * 11 // 128
            if self.us >= self.line:
                self.line += 20_000
                parts = [
                    f"{letter}{'n' if speed < 0 else 'p'}{abs(speed) // 16 // 12 * 12 / 100:.2f},"
                    for letter, speed in zip("abcd", self.speed, strict=True)
                ]
                out += "".join(parts).encode() + b"\r\n"
        return out


class NoTrailingComma(Sibling):
    """A board that reads whole lines, and misses the last value where a comma follows it."""

    rest = b""

    def write(self, data: bytes) -> None:
        *lines, self.rest = (self.rest + data).split(b"\r\n")
        for line in lines:
            taken = line[:-1].rpartition(b",")[0] if line.endswith(b",") else line
            super().write(taken + b",")

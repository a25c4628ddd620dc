"""Lines that are lost or late."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import LinkWrapper
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.protocol import encode
from acsar_gym.worlds import Scene

PERIOD = 0.01
LINES = 3000


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"droped_lines": 0.1}, "'faults.droped_lines'.*'dropped_lines' and 'late_lines'"),
        ({"unplug_rate": 0.1, "garbage_rate": 0.1}, "'dropped_lines' and 'late_lines'"),
        (["dropped_lines"], "mapping"),
    ],
)
def test_faults_that_are_unknown_are_refused(faults: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Faults.of(faults)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", Faults.model_fields)
@pytest.mark.parametrize("value", [-1.0, math.nan, None])
def test_faults_with_bad_values_name_the_field(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"faults\.{name} = "):
        Faults.of({name: value})


def numbered_line(number: int) -> bytes:
    return encode((number // 90 + 1.0, number % 90 + 1.0, 4.0, 5.0))


class CountingBoard(LinkWrapper):
    """Sends a numbered line in each period, and keeps the commands with their periods."""

    def reset(self, scene: Scene) -> None:
        self.inner.reset(scene)
        self.ticks = 0
        self.commands: list[tuple[int, bytes]] = []

    def write(self, data: bytes) -> None:
        self.commands.append((self.ticks, data))

    def advance(self, period: float) -> bytes:
        self.inner.advance(period)
        self.ticks += 1
        return numbered_line(self.ticks - 1)


Lines = list[tuple[int, bytes]]
"""Lines with the numbers of the periods in which they arrived."""


def exchange(link: FaultyLink, board: CountingBoard, ticks: int = LINES) -> tuple[Lines, Lines]:
    """Send a numbered command in each period. Returns feedback and commands that arrived."""
    link.open()
    link.reset(Scene())
    feedback = []
    for tick in range(ticks):
        link.write(numbered_line(tick))
        feedback.append((tick, link.advance(PERIOD)))
    return split_lines(feedback), split_lines(board.commands)


def split_lines(pieces: Lines) -> Lines:
    return [(tick, line) for tick, piece in pieces for line in piece.splitlines(keepends=True)]


def make_link(config: RobotConfig, seed: int, **faults: Any) -> tuple[FaultyLink, CountingBoard]:
    board = CountingBoard(open_link("planar", config))
    link = FaultyLink(board, Faults.of(faults))
    link.seed(np.random.default_rng(seed))
    return link, board


@pytest.mark.parametrize("direction", ["feedback", "commands", "both"])
def test_dropped_lines_are_a_share_of_the_lines(direction: str, config: RobotConfig) -> None:
    link, board = make_link(config, 0, direction=direction, dropped_lines=0.1)
    feedback, commands = exchange(link, board)
    for name, lines in (("feedback", feedback), ("commands", commands)):
        expected = 0.1 if direction in (name, "both") else 0.0
        assert 1.0 - len(lines) / LINES == pytest.approx(expected, abs=0.02)
        assert {line for _, line in lines} <= {numbered_line(tick) for tick in range(LINES)}


def test_late_lines_delay_those_behind_them(config: RobotConfig) -> None:
    for lines in exchange(*make_link(config, 0, late_lines=0.05, lateness=0.03)):
        assert [line for _, line in lines] == [numbered_line(n) for n in range(len(lines))]
        delays = {tick - number for number, (tick, _) in enumerate(lines)}
        assert delays == {0, 1, 2, 3}


@pytest.mark.parametrize(
    "faults",
    [{"lateness": 1.0}, {"dropped_lines": 0.5, "episodes": 0.0}, {"dropped_lines": 1e-12}],
    ids=["none", "sound episodes", "none due"],
)
def test_faults_that_are_not_due_change_nothing(faults: Any, config: RobotConfig) -> None:
    expected = [(tick, numbered_line(tick)) for tick in range(100)]
    link, board = make_link(config, 3, **faults)
    assert exchange(link, board, 100) == (expected, expected)


def test_faults_of_episodes_differ_and_their_seed_repeats_them(config: RobotConfig) -> None:
    faults = {"dropped_lines": 0.1, "late_lines": 0.1}
    link, board = make_link(config, 4, **faults)
    first = exchange(link, board, 300)
    second = exchange(link, board, 300)
    assert first != second

    link.seed(np.random.default_rng(4))
    assert [exchange(link, board, 300), exchange(link, board, 300)] == [first, second]
    assert exchange(*make_link(config, 4, **faults), 300) == first
    assert exchange(*make_link(config, 5, **faults), 300) != first

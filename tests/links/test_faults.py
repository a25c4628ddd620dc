"""Lines that are lost or late."""

from __future__ import annotations

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
        ({"unplug_rate": 0.1}, "'faults.unplug_rate'.*'dropped_lines' and 'late_lines'"),
        ({"dropped_lines": 1.1}, r"faults\.dropped_lines = 1\.1: must be less than or equal to 1"),
        ({"late_lines": -0.1}, r"faults\.late_lines = -0\.1: "),
        (["dropped_lines"], "mapping"),
    ],
)
def test_faults_that_are_unknown_or_out_of_range_are_refused(faults: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Faults.of(faults)
    assert "\n" not in str(caught.value)


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

    def split_lines(pieces: Lines) -> Lines:
        return [(tick, line) for tick, piece in pieces for line in piece.splitlines(keepends=True)]

    return split_lines(feedback), split_lines(board.commands)


def make_link(config: RobotConfig, seed: int, **faults: Any) -> tuple[FaultyLink, CountingBoard]:
    board = CountingBoard(open_link("planar", config))
    link = FaultyLink(board, Faults.of(faults))
    link.seed(np.random.default_rng(seed))
    return link, board


def test_dropped_lines_are_a_share_of_the_lines(config: RobotConfig) -> None:
    feedback, commands = exchange(*make_link(config, 0, dropped_lines=0.1))
    assert feedback != commands
    for lines in (feedback, commands):
        assert 1.0 - len(lines) / LINES == pytest.approx(0.1, abs=0.02)
        assert {line for _, line in lines} <= {numbered_line(tick) for tick in range(LINES)}


def test_late_lines_delay_those_behind_them(config: RobotConfig) -> None:
    for share, delays in ((0.05, {0, 1, 2, 3}), (1e-12, {0})):
        for lines in exchange(*make_link(config, 0, late_lines=share, lateness=0.03)):
            assert [line for _, line in lines] == [numbered_line(n) for n in range(len(lines))]
            assert {tick - number for number, (tick, _) in enumerate(lines)} == delays


def test_faults_of_episodes_differ_and_their_seed_repeats_them(config: RobotConfig) -> None:
    link, board = make_link(config, 4, dropped_lines=0.1, late_lines=0.1)
    episodes = [exchange(link, board, 300) for _ in range(2)]
    assert episodes[0] != episodes[1]
    for seed in (4, 5):
        link.seed(np.random.default_rng(seed))
        assert (exchange(link, board, 300) == episodes[0]) is (seed == 4)

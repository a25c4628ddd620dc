"""Lines that are lost, late, cut, corrupted or duplicated, and garbage between them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest
from fault_tools import (
    LINES,
    PERIOD,
    TURNING,
    Board,
    board_lines,
    drive,
    lines_of,
    on_board,
    sent,
)

from acsar_gym.links.faults import WIRE_BUFFER
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

LINE = len(TURNING)
"""Length of a line [bytes]."""


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
        changed = set(sent()) - set(lines_of(ill))
        shown = {"dropped_lines": 0.1, "cut_lines": 0.2, "corrupted_lines": 0.1}.get(name, 0.0)
        assert len(changed) / LINES == pytest.approx(shown, abs=0.035 if shown else 0.0)


def test_both_directions_suffer_by_themselves() -> None:
    link, board = on_board(dropped_lines=0.5)
    heard = lines_of(b"".join(drive(link)))
    assert len(heard) / LINES == pytest.approx(0.5, abs=0.04)
    assert len(board_lines(board)) / LINES == pytest.approx(0.5, abs=0.04)
    both = set(heard) & set(board_lines(board))
    assert len(both) / LINES == pytest.approx(0.25, abs=0.04)


def test_duplicated_lines_follow_themselves() -> None:
    link, _ = on_board(duplicated_lines=1.0)
    assert drive(link, 5) == [line * 2 for line in sent(5)]


def test_cut_lines_lose_their_tail() -> None:
    link, _ = on_board(cut_lines=0.1, direction="feedback")
    heard = drive(link)
    assert all(line.startswith(piece) for piece, line in zip(heard, sent(), strict=True))
    lengths = {len(piece) for piece in heard}
    assert lengths >= {0, 1, LINE - 2, LINE - 1, LINE}


def test_corrupted_lines_have_flipped_bits() -> None:
    link, _ = on_board(corrupted_lines=1.0, direction="feedback")
    flips = set()
    for piece, line in zip(drive(link), sent(), strict=True):
        wrong = [a ^ b for a, b in zip(piece, line, strict=True) if a != b]
        assert all(mask.bit_count() == 1 for mask in wrong)
        flips.add(len(wrong))
    assert flips == {1, 2, 3}


def test_late_lines_hold_up_those_behind_and_keep_their_order() -> None:
    link, board = on_board(late_lines=0.05, lateness=0.03)
    heard = drive(link)
    assert lines_of(b"".join(heard)) == sent(len(lines_of(b"".join(heard))))
    assert board_lines(board) == sent(len(board_lines(board)))
    delays = [tick - int(number) for tick, number in arrivals(heard)]
    assert set(delays) == {0, 1, 2, 3}
    assert b"" in heard
    delays = [round((stamp - 10.0) / PERIOD) - index for index, stamp in arrivals_on(board)]
    assert set(delays) == {0, 1, 2, 3}


def arrivals(heard: list[bytes]) -> Iterator[tuple[int, int]]:
    """(period, number of the line) of everything that was heard."""
    number = itertools.count()
    for tick, piece in enumerate(heard):
        for _ in lines_of(piece):
            yield tick, next(number)


def arrivals_on(board: Board) -> Iterator[tuple[int, float]]:
    number = itertools.count()
    for stamp, data in board.heard:
        for _ in lines_of(data):
            yield next(number), stamp


def test_a_command_that_is_late_comes_within_the_period_it_is_due() -> None:
    link, board = on_board(late_lines=1.0, lateness=0.02, direction="commands")
    link.reset(Scene())
    link.write(TURNING)
    for _ in range(5):
        link.advance(PERIOD)
    (stamp, data), *more = board.heard
    assert (round(stamp, 6), data, more) == (10.02, TURNING, [])


def test_late_lines_do_not_fill_the_memory() -> None:
    link, board = on_board(late_lines=1.0, lateness=60.0, dropped_lines=0.5)
    link.reset(Scene())
    for _ in range(10_000):
        link.write(TURNING)
    assert not board.heard
    board.clock += 61.0
    link.advance(PERIOD)
    assert WIRE_BUFFER - 40 < len(board.received()) <= WIRE_BUFFER
    assert set(board_lines(board)) == {TURNING}


def test_torn_lines_wait_for_their_end_and_no_longer() -> None:
    link, board = on_board(duplicated_lines=1.0)
    link.reset(Scene())
    for piece in (TURNING[:7], TURNING[7:-2], TURNING[-2:] + TURNING[:5]):
        link.write(piece)
    assert board.heard == [(10.0, TURNING * 2)]
    link.write(b"x" * 1000)
    assert len(board.received()) > 1000


def test_the_same_lines_suffer_however_they_are_torn() -> None:
    outcomes, counts = [], []
    stream = b"".join(sent(200))
    for size in (len(stream), LINE, 2 * LINE, 7, 100):
        link, board = on_board(5, dropped_lines=0.2, cut_lines=0.2, corrupted_lines=0.2)
        link.reset(Scene())
        for start in range(0, len(stream), size):
            link.write(stream[start : start + size])
        outcomes.append(board.received())
        counts.append(dict(link.injected))
    assert outcomes[0] == outcomes[1] == outcomes[2]
    assert counts == [counts[0]] * 5
    assert min(counts[0].values()) > 20


def test_bursts_of_garbage() -> None:
    link, board = on_board(garbage_rate=5.0, garbage_bytes=20)
    heard = b"".join(drive(link))
    seconds = LINES * PERIOD
    assert link.injected["garbage"] / (2.0 * seconds) == pytest.approx(5.0, abs=1.0)
    extra = len(heard) + len(board.received()) - 2 * LINE * LINES
    assert extra == 20 * link.injected["garbage"]
    assert len(set(heard)) == 256


def test_garbage_in_one_direction() -> None:
    link, board = on_board(garbage_rate=50.0, direction="feedback")
    heard = b"".join(drive(link, 200))
    assert board_lines(board) == sent(200)
    assert len(heard) > LINE * 200

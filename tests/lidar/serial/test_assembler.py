"""What every driver makes of the bytes of its LiDARs: turns, and when each measurement was made."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from lidar_tools import Floats, nothing, room, show_turned, shows_the_room
from lidar_twins import MAKERS, let_wobble

from acsar_gym.lidar.drivers import find_drivers
from acsar_gym.lidar.scan import Revolution
from acsar_gym.lidar.serial import RevolutionAssembler
from acsar_gym.tools.emulation.lidar import LidarTwin, Look

every_maker = pytest.mark.parametrize("model", MAKERS)
PERIOD = 0.005
"""How often bytes are read [s]."""


def make_twin(model: str, look: Look, **options: Any) -> LidarTwin:
    maker = MAKERS[model]
    twin = maker.twin(look, **{"rate": 10.0, **maker.options, **options})
    twin.receive(maker.scan)
    return twin


def stream(model: str, look: Look = room) -> bytes:
    """Half a turn, which isn't seen, and the bytes of 3.6 turns."""
    twin = make_twin(model, look)
    twin.advance(0.05)
    return b"".join(twin.advance(PERIOD) for _ in range(72))


def turns_of(model: str, data: bytes, size: int = 10_000, yaw: float = 0.0) -> list[Revolution]:
    """The revolutions from bytes that arrive in pieces of a size."""
    assembler = RevolutionAssembler(find_drivers()[model](), yaw)
    pieces = [data[at : at + size] for at in range(0, len(data), size)]
    return [turn for k, piece in enumerate(pieces) for turn in assembler.feed(piece, k * 1e-2)]


@every_maker
@pytest.mark.parametrize("size", [1, 64, 10_000])
def test_assembler_makes_whole_turns_of_any_pieces(model: str, size: int) -> None:
    turns = turns_of(model, stream(model), size)
    assert [len(turn.bearings) for turn in turns] == [MAKERS[model].options["samples"]] * 3
    assert all(map(shows_the_room, turns))


def test_assembler_turns_bearings_by_the_yaw_of_the_lidar() -> None:
    straight, turned = (turns_of("ld06", stream("ld06"), yaw=yaw)[0].bearings for yaw in (0.0, 1.5))
    assert np.exp(1j * (turned - straight - 1.5)) == pytest.approx(1.0)
    assert np.abs(turned).max() <= math.pi


@every_maker
def test_assembler_drops_a_turn_that_lost_bytes(model: str) -> None:
    data = stream(model)
    complete = len(turns_of(model, data)[0].bearings)
    rng = np.random.default_rng(0)
    for first in rng.integers(len(data) // 5, len(data) // 2, 40):
        count = int(rng.choice([1, 3, 47, 90, 300]))
        turns = turns_of(model, data[:first] + data[first + count :])
        assert len(turns) < 3
        for turn in turns:
            assert shows_the_room(turn)
            assert len(turn.bearings) == complete


@every_maker
def test_assembler_refuses_what_is_no_measurement(model: str) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, 50_000, np.uint8).tobytes()
    assert not turns_of(model, noise)
    turns = turns_of(model, noise[:1000] + stream(model), 64)
    assert len(turns) == 3
    assert all(map(shows_the_room, turns))


@every_maker
def test_assembler_interpolates_bearings_of_failed_measurements(model: str) -> None:
    def look(bearings: Floats, ages: Floats) -> Floats:
        return np.where(np.abs(bearings % 6.28) < 2.0, np.inf, room(bearings))

    for turn in turns_of(model, stream(model, look)):
        missed = turn.distances == 0.0
        assert 0.1 < missed.mean() < 0.6
        assert np.abs(turn.distances - room(turn.bearings))[~missed].max() < 0.01
        assert np.degrees(np.abs(show_turned(turn)).max()) < 8.0  # an X4's beam deviates by 12
    for turn in turns_of(model, stream(model, nothing)):
        assert not turn.distances.any()
        assert np.degrees(np.abs(show_turned(turn)).max()) < 2.0


def read_late(twin: LidarTwin, jitter: float, baud: float) -> Iterator[tuple[float, bytes]]:
    """Yield bytes as they come to a reader that is late by up to `jitter` [s], and when."""
    rng = np.random.default_rng(1)
    due = PERIOD
    sent = waiting = b""
    for tick in range(1, 1250):
        now = 0.002 * tick
        sent += twin.advance(0.002)
        count = int(min(baud / 10.0 * 0.002, len(sent)))
        waiting += sent[:count]
        sent = sent[count:]
        if now >= due:
            yield now, waiting
            waiting = b""
            due = now + PERIOD + float(rng.choice([0.0, rng.uniform(0.0, jitter)]))


@every_maker
@pytest.mark.parametrize(
    ("wobble", "jitter", "slow"),
    [(0.0, 0.0, False), (0.0, 0.02, True), (0.25, 0.0, True), (0.25, 0.02, False)],
)
def test_assembler_times_each_measurement(
    model: str, wobble: float, jitter: float, slow: bool
) -> None:
    """Whether its bytes come one after the other, as through a slow wire, or all at once."""

    def tell_time(bearings: Floats, ages: Floats) -> Floats:
        return 1.0 + (twin._now - ages) % 3.0

    rate = 4.5 if model == "neato" else 6.0  # its wire carries no more than 5.8
    twin = make_twin(model, tell_time, rate=rate)
    let_wobble(twin, wobble)
    assembler = RevolutionAssembler(find_drivers()[model]())
    turns = 0
    for now, data in read_late(twin, jitter, MAKERS[model].baud if slow else math.inf):
        for turn in assembler.feed(data, now):
            turns += 1
            late = (turn.times + 1.0 - turn.distances + 1.5) % 3.0 - 1.5
            assert np.abs(late).max() < 0.005
            assert turn.stamp <= now
    assert turns > 6

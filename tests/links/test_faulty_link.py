"""Faults in a link: of lines, encoders, wheels, boards, supplies and cables."""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serial_tools import Emulated, StartEmulator, no_leak, wait_until
from tapes import recorded

from acsar_gym import Link, Robot, RobotConfig, open_link
from acsar_gym.errors import BoardSilentError, ConfigError, LinkLostError, PortNotFoundError
from acsar_gym.links.faults import WIRE_BUFFER, FaultSeed, FaultyLink
from acsar_gym.physics.body import Camera, GroundTruth, Image
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")


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


def test_wheels_are_drawn_anew_with_every_episode() -> None:
    link, _ = on_board(dead_wheels=1)
    seen = set()
    for _ in range(60):
        link.reset(Scene())
        seen.add(link.wheels.dead)
    assert seen == {"a", "b", "c", "d"}


@pytest.mark.parametrize("name", ["board_reset", "brown_out"])
def test_a_board_that_is_down_says_and_hears_nothing(name: str) -> None:
    link, board = on_board(0, **{f"{name}_at": 0.5, "reset_time": 0.4, "brown_out_time": 0.4})
    heard = drive(link, 200)
    assert heard[:49] == sent(49)
    assert not any(heard[49:89])
    assert heard[89:] == sent(200)[89:]
    assert link.injected == {name: 1}
    obeyed = [speeds for _, data in board.heard[50:90] for speeds in [r.speeds for r in feed(data)]]
    assert set(obeyed) == {ZERO}
    assert board_lines(board)[-110:] == sent(200)[-110:]


def feed(data: bytes) -> list[Any]:
    return list(Decoder().feed(data))


def test_a_reset_lasts_two_seconds_and_ends_at_rest(config: RobotConfig) -> None:
    link = planar(config, board_reset_at=1.0)
    link.open()
    link.reset(Scene())
    heard = []
    for _ in range(500):
        link.write(TURNING)
        heard.append(link.advance(PERIOD))
    silent = [tick for tick, piece in enumerate(heard) if not piece and tick > 5]
    assert (silent[0], silent[-1], len(silent)) == (99, 298, 200)
    assert feed(heard[98])[0].speeds == pytest.approx(AS_TURNED, abs=0.2)
    assert feed(heard[299])[0].speeds == ZERO
    assert feed(heard[-1])[0].speeds == pytest.approx(AS_TURNED, abs=0.2)
    link.close()


def test_the_rate_of_resets() -> None:
    link, _ = on_board(board_reset_rate=2.0, reset_time=0.1)
    for _ in range(2):
        drive(link, 10_000)
        assert link.injected["board_reset"] / 100.0 == pytest.approx(1.0 / 0.6, abs=0.4)


def test_silence_is_an_error_and_a_dip_is_none(config: RobotConfig) -> None:
    config = config.with_(feedback_timeout=0.5)
    with Robot(planar(config, brown_out_at=0.5), config) as robot:
        ages = []
        for _ in range(200):
            robot.drive(0.3, 0.0)
            ages.append(robot.feedback_age)
        assert max(ages) == pytest.approx(0.3, abs=0.02)
        assert robot.odometry.twist[0] == pytest.approx(0.3, abs=0.02)
    robot = Robot(planar(config, board_reset_at=0.5), config)
    robot.activate()
    with pytest.raises(BoardSilentError, match="no feedback for"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
    assert not robot.active
    robot.reset(Scene())
    robot.drive(0.3, 0.0)
    robot.deactivate()


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


def test_a_cable_that_stays_out() -> None:
    link, board = on_board(unplug_at=0.1, replug_time=math.inf)
    with pytest.raises(LinkLostError):
        drive(link, 50)
    assert board.closed == 1
    for _ in range(2):
        with pytest.raises(PortNotFoundError, match="/dev/board0: no such device"):
            link.open()
    link.close()
    link.close()
    assert board.opened == 1


def test_another_device_takes_the_place_of_the_pulled_one() -> None:
    boards = [Board(), Board()]
    boards[1].device = "/dev/board1"
    link = FaultyLink(boards[0], {"unplug_at": 0.1}, relink=lambda: boards[1])
    with pytest.raises(LinkLostError, match="board0"):
        drive(link, 50)
    assert boards[1].opened == 0
    drive(link, 5)
    assert link.device == "/dev/board1"
    assert board_lines(boards[1]) == sent(5)
    assert boards[0].closed == 1


def test_a_device_that_cannot_be_opened_leaves_the_cable_out() -> None:
    class Missing(Board):
        def open(self) -> None:
            raise PortNotFoundError("/dev/board1: no such device")

    made: list[Link] = [Missing(), Board()]
    link = FaultyLink(Board(), {"unplug_at": 0.0}, relink=lambda: made.pop(0))
    with pytest.raises(LinkLostError):
        drive(link, 1)
    with pytest.raises(PortNotFoundError, match="board1"):
        link.open()
    with pytest.raises(LinkLostError):
        link.write(TURNING)
    link.open()
    link.advance(PERIOD)


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


@pytest.mark.parametrize("faults", [None, {}, {"lateness": 1.0, "reset_time": 1.0}])
def test_without_faults_every_piece_passes_as_it_comes(faults: Any) -> None:
    board = Board()
    link = FaultyLink(board, faults, seed=3)
    assert drive(link, 100) == sent(100)
    for piece in (b"ap1", b"", b"2.50\r", b"\n\xff"):
        link.write(piece)
    assert [data for _, data in board.heard] == [*sent(100), b"ap1", b"", b"2.50\r", b"\n\xff"]
    assert not link.injected


def test_sound_episodes_and_sound_lines_are_the_same_bytes() -> None:
    link, board = on_board(0, **{**EVERYTHING, "episodes": 0.0})
    assert drive(link, 100) == board_lines(board)[:100] == sent(100)
    link, board = on_board(dropped_lines=1e-12, unplug_at=1e9, wheel_faults_at=1e9, dead_wheels=2)
    assert drive(link, 100) == board_lines(board)[:100] == sent(100)


def test_what_stands_behind_shows_through() -> None:
    link, board = on_board(dropped_lines=1.0)
    assert link.device == "/dev/board0"
    assert link.link is board
    assert link.camera is board
    assert (link.truth, link.lateness, link.now()) == (None, 0.004, 0.0)
    simulated = FaultyLink(open_link("planar"), None)
    simulated.reset(Scene(start=(1.0, 2.0, 0.0)))
    assert simulated.truth is not None
    assert simulated.truth.pose == (1.0, 2.0, 0.0)
    assert simulated.device == "robot0"
    simulated.close()


def everything(seed: FaultSeed, config: RobotConfig, episodes: int = 2) -> list[bytes]:
    link = planar(config, seed, **EVERYTHING)
    return [piece for _ in range(episodes) for piece in drive(link, 300)]


def test_the_same_seed_gives_the_same_bytes(config: RobotConfig) -> None:
    assert everything(4, config) == everything(4, config)
    assert everything(4, config) != everything(5, config)
    assert everything(None, config) != everything(None, config)


def test_episodes_differ_and_reseeding_repeats_them() -> None:
    link, _ = on_board(**EVERYTHING)
    first, second = drive(link, 300), drive(link, 300)
    assert first != second
    link.seed(0)
    assert drive(link, 300) == first
    assert drive(link, 300) == second
    link.seed(np.int64(0))
    assert drive(link, 300) == first


def test_a_generator_gives_one_number_and_is_left_alone() -> None:
    rng, twin = np.random.default_rng(8), np.random.default_rng(8)
    link, _ = on_board(rng, **EVERYTHING)
    drive(link, 300)
    twin.random()
    assert rng.random() == twin.random()


def test_commands_do_not_change_what_happens_to_feedback() -> None:
    heard = []
    for commands in (1, 2):
        link, _ = on_board(6, **{**EVERYTHING, "board_reset_rate": 0.0, "brown_out_rate": 0.0})
        link.reset(Scene())
        pieces = []
        for _ in range(300):
            for _ in range(commands):
                link.write(TURNING)
            pieces.append(link.advance(PERIOD))
        heard.append(pieces)
    assert heard[0] == heard[1]


@pytest.mark.parametrize("seed", [-1, 1.5, "1"])
def test_seeds_that_are_none(seed: Any) -> None:
    with pytest.raises(ConfigError, match="seed"):
        FaultyLink(Board(), None, seed)


def test_copies_are_links_of_their_own(config: RobotConfig) -> None:
    link = planar(config, 9, **EVERYTHING)
    first = drive(link, 200)
    again = copy.deepcopy(link)
    assert again.link is not link.link
    assert drive(again, 200) == first
    link.close()
    again.close()


@pytest.mark.parametrize("name", ["planar", "bullet"])
def test_the_robot_drives_on_through_bad_lines(name: str, config: RobotConfig) -> None:
    faults = {key: 0.1 for key in EVERYTHING if key.endswith("_lines")} | {"garbage_rate": 3.0}
    link = FaultyLink(open_link(name, config), faults, seed=2)
    with Robot(link, config.with_(feedback_timeout=0.5)) as robot:
        for _ in range(500):
            robot.drive(0.3, 0.0)
        truth = link.truth
        assert truth is not None
        assert truth.pose[0] > 1.0
        assert robot.odometry.pose[0] == pytest.approx(truth.pose[0], rel=0.3)
        assert robot.decoder.refused
        assert min(link.injected[key] for key in ("dropped_lines", "cut_lines", "garbage")) > 5


def test_a_recording_keeps_what_the_driver_heard(config: RobotConfig, tmp_path: Path) -> None:
    tape = tmp_path / "tape.mcap"
    with recorded(planar(config, 3, **EVERYTHING), tape, config) as link:
        link.open()
        link.reset(Scene())
        heard = [link.advance(PERIOD) for _ in range(300)]
        link.close()
    replayed = open_link(f"replay:{tape}", config)
    replayed.reset(Scene())
    assert [replayed.advance(PERIOD) for _ in range(300)] == heard


def test_over_a_real_device_the_robot_drives_on(config: RobotConfig, emulator: Emulated) -> None:
    faults = {key: 0.1 for key in EVERYTHING if key.endswith("_lines")}
    faults |= {"garbage_rate": 10.0, "brown_out_at": 0.5, "brown_out_time": 0.2}
    config = config.with_(wheel_check=False)  # a dip takes longer on a busy machine
    link = FaultyLink(open_link(emulator.device, config), faults, seed=2)
    assert link.device == emulator.device
    with Robot(link, config) as robot:
        oldest = 0.0
        while oldest < 0.15 or robot.feedback_age > 0.0:  # through the brown-out
            robot.drive(0.3, 0.0)
            oldest = max(oldest, robot.feedback_age)
        assert robot.odometry.pose[0] > 0.02
        assert robot.decoder.refused
        assert link.injected["brown_out"] == 1
    assert b"ap00.00,bp00.00,cp00.00,dp00.00" in emulator.received()
    wait_until(emulator.is_stopped, "wheels at rest")


def test_over_a_real_device_silence_is_an_error(config: RobotConfig, emulator: Emulated) -> None:
    config = config.with_(feedback_timeout=0.6)
    faults = {"board_reset_at": 0.1, "reset_time": 60.0}
    robot = Robot(FaultyLink(open_link(emulator.device, config), faults, 0), config)
    with no_leak():
        robot.activate()
        start = time.monotonic()
        with pytest.raises(BoardSilentError):
            while True:
                robot.drive(0.3, 0.0)
        assert time.monotonic() - start > 0.6
        robot.close()
    wait_until(emulator.is_stopped, "wheels at rest")


def test_a_real_device_comes_back_under_another_name(
    config: RobotConfig, start_emulator: StartEmulator
) -> None:
    first, second = start_emulator(), start_emulator()
    link = FaultyLink(
        open_link(first.device, config),
        {"unplug_at": 0.5, "replug_time": 0.5},
        relink=lambda: open_link(second.device, config),
    )
    robot = Robot(link, config)
    with no_leak():
        robot.activate()
        with pytest.raises(LinkLostError, match=first.device):
            while True:
                robot.drive(0.3, 0.0)
        lost = time.monotonic()
        wait_until(first.is_stopped, "wheels at rest")
        first.kill()
        robot.reset(Scene())
        assert time.monotonic() - lost > 0.4
        assert link.device == second.device != first.device
        while robot.odometry.pose[0] == 0.0:
            robot.drive(0.3, 0.0)
        robot.close()
    wait_until(second.is_stopped, "wheels at rest")

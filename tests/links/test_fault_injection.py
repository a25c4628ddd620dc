"""Faults in a link: what passes unchanged, seeds, and the driver on top, over all kinds of link."""

from __future__ import annotations

import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_tools import (
    EVERYTHING,
    PERIOD,
    TURNING,
    Board,
    board_lines,
    drive,
    lines_of,
    on_board,
    planar,
    readings,
    sent,
)
from serial_tools import Emulated, StartEmulator, no_leak, wait_until
from tapes import TICKS, recorded, taped

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import BoardSilentError, ConfigError, LinkLostError
from acsar_gym.links.faults import FaultSeed, FaultyLink
from acsar_gym.links.replay import ReplayLink
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")


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


def test_the_share_of_sound_episodes() -> None:
    link, _ = on_board(dropped_lines=1.0, episodes=0.3)
    ill = sum(not any(drive(link, 3)) for _ in range(500))
    assert ill / 500 == pytest.approx(0.3, abs=0.08)


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


def test_faults_add_up_link_on_link() -> None:
    board = Board()
    inner = FaultyLink(board, {"dropped_lines": 0.5, "direction": "feedback"}, 1)
    outer = FaultyLink(inner, {"duplicated_lines": 1.0, "direction": "commands"}, 2)
    heard = drive(outer, 1000)
    assert len(lines_of(b"".join(heard))) == pytest.approx(500, abs=60)
    assert board_lines(board) == [line for line in sent(1000) for _ in range(2)]
    assert outer.device == "/dev/board0"


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


def test_faults_over_a_recording(config: RobotConfig, tmp_path: Path) -> None:
    tape = taped(tmp_path / "tape.mcap", config)
    link = FaultyLink(ReplayLink(tape, compare=False), {"reversed_encoders": "abcd"}, 0)
    link.reset(Scene())
    heard = [link.advance(PERIOD) for _ in range(TICKS)]
    assert readings(heard)[-1] == pytest.approx((-3.0, -3.0, -3.0, -3.0), abs=0.2)
    with pytest.raises(LinkLostError, match="episode ends here"):
        link.advance(PERIOD)
    link.close()


def test_over_a_real_device_the_robot_drives_on(config: RobotConfig, emulator: Emulated) -> None:
    faults = {key: 0.1 for key in EVERYTHING if key.endswith("_lines")}
    faults |= {"garbage_rate": 10.0, "brown_out_at": 0.5, "brown_out_time": 0.2}
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

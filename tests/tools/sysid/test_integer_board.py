"""A board that isn't ours is identified: its integers are no misfit."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import integer_board
import numpy as np
import pytest
from integer_board import SLOWER, BoardProgram, IntegerLink
from sysid_tools import ACSAR, find_missed_truths

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.links import Link, open_link
from acsar_gym.recording import read
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.tools.sysid.identify import (
    GAP_NOISE,
    NO_RAMP,
    Identification,
    identify_device,
)
from acsar_gym.tools.sysid.twin_gap import measure_gap
from acsar_gym.worlds import Scene


def identify(program: BoardProgram, phase: float = 3.0) -> Identification:
    return identify_device(IntegerLink(program, phase), ACSAR, 20.0)


def describe(program: BoardProgram) -> RobotConfig:
    """The robot that has this board; what its intervals have to hold."""
    return ACSAR.with_(
        motor={
            "time_constant": program.lag,
            "gain": tuple(percent / 100.0 for percent in program.gain),
            "acceleration": float(program.ramp) or NO_RAMP,
            "deadband": program.deadband / 100.0,
        },
        firmware={
            "command_delay": 1e-3 * program.delay,
            "feedback_rate": 1e3 / program.feedback,
            "command_timeout": 1e-3 * program.timeout or None,
        },
        encoder={"quantum": program.quantum / 100.0, "window": 0.005},
    )


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(BoardProgram())


def test_it_is_identified(found: Identification) -> None:
    found.check()
    assert find_missed_truths(found, describe(BoardProgram())) == []
    assert found.held_out is not None
    assert found.held_out.after < 2.0 * GAP_NOISE
    assert found.robot().motor_fit == "fits"


def drive_goals(program: BoardProgram, path: Path) -> None:
    """Record drives to three goals."""
    env = gymnasium.make(
        "acsar_gym/PointGoal-v0", link=IntegerLink(program, 1.0), robot=ACSAR, record=path
    )
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            ahead, aside = observation[1], observation[2]  # as policies do: at full speed
            action = np.clip(np.array([3.0 * ahead, 3.0 * aside], np.float32), -1.0, 1.0)
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    env.close()


def test_its_gap_is_at_most_half_of_the_presets(found: Identification, tmp_path: Path) -> None:
    drive_goals(BoardProgram(), tmp_path / "drives.mcap")
    logs = [("drives", read(tmp_path / "drives.mcap"))]
    gap = measure_gap(logs, ("identified", found.robot()), ("acsar", ACSAR))
    before, after = gap.figures("before"), gap.figures("after")
    assert after["wheel_speed_rms"] < 0.5 * before["wheel_speed_rms"]
    assert abs(after["time_shift"]) < 0.002


def replay(wire: WireLog, link: Link, shift: float) -> tuple[Floats, Floats]:
    """Feedback to recorded commands that come `shift` later by the board's clock [s]."""
    link.open()
    link.reset(Scene())
    link.advance(0.1 + shift)
    begin = link.now() - float(wire.sent_stamps[0])
    got: list[tuple[float, bytes]] = []
    for stamp, data in zip(wire.sent_stamps.tolist(), wire.sent, strict=True):
        link.advance(max(0.0, begin + stamp - link.now()))
        got += link.arrivals
        link.write(data)
    stamps = np.array([stamp for stamp, _ in got])
    pieces = tuple(piece for _, piece in got)
    return WireLog(wire.sent_stamps, wire.sent, stamps - begin, pieces).feedback(ACSAR)


@pytest.mark.slow
def test_a_repeated_drive_differs_by_the_noise_of_gap(tmp_path: Path) -> None:
    """With other phases of the board's clocks. `pytest -s` prints it."""
    drive_goals(BoardProgram(), tmp_path / "drives.mcap")
    episode = read(tmp_path / "drives.mcap").episodes[0]
    boards: dict[str, Callable[[], Link]] = {
        "integer board": lambda: IntegerLink(BoardProgram()),
        "slower": lambda: IntegerLink(SLOWER),
        "acsar": lambda: open_link("planar", ACSAR),
    }
    for name, make in boards.items():
        sides = [replay(episode.wire, make(), 0.0021 * k) for k in range(10)]
        apart = []
        for (stamps, speeds), (others, theirs) in itertools.combinations(sides, 2):
            near = np.column_stack([np.interp(stamps, others, column) for column in theirs.T])
            apart.append(float(np.sqrt(np.mean((speeds - near) ** 2))))
        print(f"{name}: {np.median(apart):.3f} rad/s, at most {max(apart):.3f}")
        assert 0.2 * GAP_NOISE < max(apart) < 1.1 * GAP_NOISE


@pytest.mark.parametrize(
    "program",
    [
        BoardProgram(feedback=100, noise=10),
        pytest.param(SLOWER, marks=pytest.mark.slow),
        pytest.param(BoardProgram(ramp=40, feedback=10), marks=pytest.mark.slow),
        pytest.param(BoardProgram(gain=(100, 100, 85, 100)), marks=pytest.mark.slow),
        pytest.param(BoardProgram(delay=40, timeout=0), marks=pytest.mark.slow),
        pytest.param(BoardProgram(deadband=60, fraction=64), marks=pytest.mark.slow),
    ],
)
def test_its_variants_are_identified(program: BoardProgram) -> None:
    found = identify(program)
    found.check()
    assert find_missed_truths(found, describe(program)) == []
    gains = [finding for finding in found.findings if finding.name == "motor.gain"]
    assert (len(gains) > 1) == (len(set(program.gain)) > 1)


def test_whole_numbers_are_a_step_of_one() -> None:
    found = identify(BoardProgram(quantum=100))
    quantum = next(finding for finding in found.findings if finding.name == "encoder.quantum")
    assert quantum.told
    assert quantum.value == pytest.approx(1.0, abs=1e-3)
    assert find_missed_truths(found, describe(BoardProgram(quantum=100))) == []


@pytest.mark.parametrize(
    "program",
    [
        BoardProgram(repeat=300),
        pytest.param(BoardProgram(backward=85), marks=pytest.mark.slow),
        pytest.param(BoardProgram(top=600), marks=pytest.mark.slow),
        pytest.param(BoardProgram(hold=200), marks=pytest.mark.slow),
    ],
)
def test_what_changes_a_drive_is_refused(program: BoardProgram) -> None:
    found = identify(program)
    with pytest.raises(AcsarError, match="wheel speeds are missed by"):
        found.check()
    assert found.robot().motor_fit.startswith("doesn't fit")


@pytest.mark.slow
@pytest.mark.usefixtures("deadline")
def test_it_is_identified_over_a_pseudo_terminal() -> None:
    patient = ACSAR.with_(watchdog_timeout=5.0, feedback_timeout=10.0)
    program = [sys.executable, integer_board.__file__]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as board:
        try:
            assert board.stdout is not None
            device = board.stdout.readline().split()[-1]
            found = identify_device(open_link(device, patient), patient, 20.0)
        finally:
            board.terminate()
    found.check()
    lag = next(one for one in found.findings if one.name == "motor.time_constant")
    assert lag.value == pytest.approx(BoardProgram().lag, rel=0.05)

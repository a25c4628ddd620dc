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
from acsar_gym.recording.types import Floats, WireLog
from acsar_gym.tools.sysid.identify import GAP_NOISE, NO_RAMP, Identification, identify_device
from acsar_gym.tools.sysid.twin_gap import measure_gap
from acsar_gym.worlds import Scene


def identify(program: BoardProgram) -> Identification:
    return identify_device(IntegerLink(program, 3.0), ACSAR, 20.0)


def describe(program: BoardProgram) -> RobotConfig:
    """The robot that has this board, whose values the intervals must hold."""
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
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drives of the board to three goals, at full speed as policies drive."""
    path = tmp_path_factory.mktemp("integer") / "drives.mcap"
    link = IntegerLink(BoardProgram(), 1.0)
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=ACSAR, record=path)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            action = np.clip(3.0 * observation[1:3], -1.0, 1.0).astype(np.float32)
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    env.close()
    return path


def test_measure_gap_of_the_identified_board(drives: Path) -> None:
    """`gap` of held-out drives was 0.075 rad/s when this was written."""
    result = identify(BoardProgram())
    result.check()
    assert find_missed_truths(result, describe(BoardProgram())) == []
    assert result.held_out is not None
    assert result.held_out.after < 2.0 * GAP_NOISE
    gap = measure_gap([("drives", read(drives))], ("found", result.robot()), ("acsar", ACSAR))
    assert gap.held_out
    assert gap.figures("after")["wheel_speed_rms"] < 0.082
    assert gap.figures("after")["wheel_speed_rms"] < 0.5 * gap.figures("before")["wheel_speed_rms"]
    assert abs(gap.figures("after")["time_shift"]) < 0.002


def replay(wire: WireLog, link: Link, shift: float) -> tuple[Floats, Floats]:
    """Feedback to recorded commands that come `shift` later by the board's clock [s]."""
    link.open()
    link.reset(Scene())
    link.advance(0.1 + shift)
    start = link.now() - float(wire.sent_stamps[0])
    got: list[tuple[float, bytes]] = []
    for stamp, data in zip(wire.sent_stamps.tolist(), wire.sent, strict=True):
        link.advance(max(0.0, start + stamp - link.now()))
        got += [(when - start, piece) for when, piece in link.arrivals]
        link.write(data)
    return WireLog.of((), got).feedback(ACSAR)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        lambda: IntegerLink(BoardProgram()),
        lambda: IntegerLink(SLOWER),
        lambda: open_link("planar", ACSAR),
    ],
    ids=["integer", "slower", "acsar"],
)
def test_gap_noise_is_that_of_repeated_drives(drives: Path, make: Callable[[], Link]) -> None:
    """With other phases of the board's clocks. `pytest -s` prints it."""
    wire = read(drives).episodes[0].wire
    sides = [replay(wire, make(), 0.0021 * k) for k in range(10)]
    distances = []
    for (stamps, speeds), (other_stamps, other_speeds) in itertools.combinations(sides, 2):
        near = [np.interp(stamps, other_stamps, column) for column in other_speeds.T]
        distances.append(float(np.sqrt(np.mean((speeds.T - near) ** 2))))
    print(f"{np.median(distances):.3f} rad/s, at most {max(distances):.3f}")
    assert 0.2 * GAP_NOISE < max(distances) < 1.1 * GAP_NOISE


@pytest.mark.parametrize(
    "program",
    [
        BoardProgram(feedback=100, noise=10),
        BoardProgram(quantum=100),
        pytest.param(SLOWER, marks=pytest.mark.slow),
        pytest.param(BoardProgram(ramp=40, feedback=10), marks=pytest.mark.slow),
        pytest.param(BoardProgram(gain=(100, 100, 85, 100)), marks=pytest.mark.slow),
        pytest.param(BoardProgram(delay=40, timeout=0), marks=pytest.mark.slow),
        pytest.param(BoardProgram(deadband=60, fraction=64), marks=pytest.mark.slow),
    ],
)
def test_identify_device_finds_variants(program: BoardProgram) -> None:
    result = identify(program)
    assert find_missed_truths(result, describe(program)) == []
    named = {finding.name: finding.wheel for finding in result.findings if finding.told}
    assert (named["motor.gain"] != "") == (len(set(program.gain)) > 1)
    assert program.quantum < 100 or "encoder.quantum" in named


@pytest.mark.parametrize(
    "program",
    [
        BoardProgram(repeat=300),
        pytest.param(BoardProgram(backward=85), marks=pytest.mark.slow),
        pytest.param(BoardProgram(hold=200), marks=pytest.mark.slow),
    ],
)
def test_check_refuses_what_changes_a_drive(program: BoardProgram) -> None:
    result = identify(program)
    with pytest.raises(AcsarError, match="wheel speeds are missed by"):
        result.check()
    assert result.robot().motor_fit.startswith("doesn't fit")


@pytest.mark.slow
@pytest.mark.usefixtures("deadline")
def test_identify_device_over_a_pseudo_terminal() -> None:
    patient = ACSAR.with_(watchdog_timeout=5.0, feedback_timeout=10.0)
    program = [sys.executable, integer_board.__file__]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as board:
        try:
            assert board.stdout is not None
            device = board.stdout.readline().split()[-1]
            result = identify_device(open_link(device, patient), patient, 20.0)
        finally:
            board.terminate()
    result.check()
    lag = next(finding for finding in result.findings if finding.name == "motor.time_constant")
    assert lag.value == pytest.approx(BoardProgram().lag, rel=0.05)

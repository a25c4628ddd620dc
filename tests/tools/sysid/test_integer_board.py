"""A board that isn't ours is identified: its integers are no misfit."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from integer_board import FEEDBACK, SLOWER, BoardProgram, IntegerLink
from sysid_tools import ACSAR, find_missed_truths

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.recording import read
from acsar_gym.tools.sysid.identify import NO_RAMP, Identification, identify_device
from acsar_gym.tools.sysid.twin_gap import measure_gap


def identify(program: BoardProgram) -> Identification:
    return identify_device(IntegerLink(program, 3.0), ACSAR, 20.0)


def describe(program: BoardProgram) -> RobotConfig:
    """The robot that has this board, whose values the intervals must hold."""
    return ACSAR.with_(
        motor={
            "time_constant": program.lag,
            "gain": tuple(percent / 100.0 for percent in program.gain),
            "acceleration": NO_RAMP,
            "deadband": program.deadband / 100.0,
        },
        firmware={
            "command_delay": 1e-3 * program.delay,
            "feedback_rate": 1e3 / FEEDBACK,
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
    gap = measure_gap([("drives", read(drives))], ("found", result.robot()), ("acsar", ACSAR))
    assert gap.held_out
    assert gap.figures("after")["wheel_speed_rms"] < 0.082
    assert gap.figures("after")["wheel_speed_rms"] < 0.5 * gap.figures("before")["wheel_speed_rms"]
    assert abs(gap.figures("after")["time_shift"]) < 0.002


@pytest.mark.parametrize(
    "program",
    [
        BoardProgram(quantum=100),
        pytest.param(SLOWER, marks=pytest.mark.slow),
        pytest.param(
            BoardProgram(gain=(100, 100, 85, 100), delay=40, timeout=0), marks=pytest.mark.slow
        ),
        pytest.param(BoardProgram(deadband=60, fraction=64), marks=pytest.mark.slow),
    ],
)
def test_identify_device_finds_variants(program: BoardProgram) -> None:
    result = identify(program)
    assert find_missed_truths(result, describe(program)) == []
    named = {finding.name: finding.wheel for finding in result.findings if finding.told}
    assert (named["motor.gain"] != "") == (len(set(program.gain)) > 1)
    assert program.quantum < 100 or "encoder.quantum" in named


def test_check_refuses_a_board_that_repeats_old_lines() -> None:
    result = identify(BoardProgram(repeat=300))
    with pytest.raises(AcsarError, match="wheel speeds are missed by"):
        result.check()
    assert result.robot().motor_fit.startswith("doesn't fit")

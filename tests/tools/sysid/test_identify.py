"""Hidden robots are identified in simulated time, and bad logs are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sysid_tools import (
    ACSAR,
    TOLERANCES,
    drive_wire,
    find_missed_truths,
    identify_simulated,
    score_findings,
)

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.recording import Recorder
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board_log import Estimate
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.identify import (
    Identification,
    identification_table,
    identify_files,
    identify_logs,
    merge_wheels,
)

HIDDEN = ACSAR.with_(
    motor={
        "time_constant": 0.15,
        "gain": (0.95, 1.0, 1.05, 0.98),
        "deadband": 0.4,
        "acceleration": 40.0,
    },
    firmware={"command_delay": 0.02, "feedback_rate": 50.0, "command_timeout": 0.6},
    encoder={"quantum": 0.07},
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manoeuvre of the hidden robot, recorded."""
    path = tmp_path_factory.mktemp("identified") / "manoeuvre.mcap"
    drive_excitation(open_link("planar", HIDDEN), ACSAR, 12.0, Recorder(path))
    return path


@pytest.fixture(scope="module")
def hidden(recording: Path) -> Identification:
    """What is found in that recording."""
    return identify_files([recording], ACSAR)


def test_identify_files_finds_a_hidden_robot(hidden: Identification) -> None:
    scores = score_findings(hidden, HIDDEN)
    assert {score.name for score in scores} >= set(TOLERANCES)
    for score in scores:
        assert score.error <= 1.0 or score.name not in TOLERANCES, score
        assert score.holds, score
    hidden.check()
    assert hidden.held_out is not None
    assert hidden.held_out.after < 1.3 * hidden.held_out.noise
    assert identification_table(hidden).row_count == len(hidden.findings)


def test_robot_has_values_intervals_and_logs(hidden: Identification, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    hidden.robot().save(path)
    robot = RobotConfig.load(path)
    assert robot.motor.gain == pytest.approx((0.95, 1.0, 1.05, 0.98), rel=0.01)
    assert robot.firmware.command_timeout == pytest.approx(0.6, abs=0.06)
    assert robot.encoder.quantum == pytest.approx(0.07, abs=1e-3)
    gain = robot.measured["motor.gain.b"]
    assert gain.low <= 1.0 <= gain.high
    assert gain.logs == hidden.logs
    assert len(robot.firmware.delay_samples) == 10
    assert (robot.motor_fit, robot.misfit) == ("fits", "")


def test_robot_can_be_written_for_a_very_short_timeout() -> None:
    board = ACSAR.with_(firmware={"command_timeout": 0.012, "feedback_rate": 20.0})
    robot = identify_simulated(board).robot()
    assert robot.firmware.command_timeout == pytest.approx(0.012, abs=0.01)
    assert robot.measured["firmware.command_timeout"].low == 1e-3


@pytest.mark.parametrize(
    ("quirk", "message"),
    [
        ("backward-gain=0.85", "wheel speeds are missed by"),
        ("feedback-factor=9.55", "times the expected speed: likely feedback in rpm"),
    ],
)
def test_check_refuses_a_board_outside_the_model(quirk: str, message: str) -> None:
    result = identify_simulated(HIDDEN, quirk)
    assert message in result.misfit
    with pytest.raises(AcsarError, match="--anyway"):
        result.check()
    result.check(anyway=True)
    assert message in result.robot().misfit


def test_misfit_is_empty_for_values_of_the_robots_file() -> None:
    motor = {"max_speed": 6.0, "gain": (1.0, 1.6, 1.0, 1.0)}
    log = drive_excitation(open_link("planar", HIDDEN.with_(motor=motor)), ACSAR, 14.0)
    assert not identify_logs([log], ACSAR.with_(motor=motor)).misfit


def test_dead_names_wheels_that_never_turned() -> None:
    result = identify_simulated(ACSAR.with_(motor={"deadband": (0.0, 0.0, 20.0, 20.0)}))
    assert result.dead == ("rear_left", "rear_right")
    result.check()

    # The drive has no recording, but its intervals have a source.
    assert [len(log) for log in result.logs] == [16]
    assert result.robot().measured["motor.gain.a"].logs == result.logs


def test_identify_logs_keeps_what_a_drive_does_not_show() -> None:
    log = drive_wire(lambda time: 6.0 * np.sin(0.2 * time), HIDDEN, 20.0)
    result = identify_logs([log], ACSAR)
    result.check()
    assert find_missed_truths(result, HIDDEN) == []
    findings = {finding.name: finding for finding in result.findings}
    assert findings["motor.gain"].told
    assert findings["motor.deadband"].told
    for name in ("motor.acceleration", "firmware.command_delay", "firmware.command_timeout"):
        assert (findings[name].value, findings[name].told) == (None, False)
        assert "not narrowed by this log: drive" in findings[name].note


def test_identify_logs_finds_no_rate_in_a_few_lines() -> None:
    for seconds, told in ((0.5, False), (1.5, True)):
        log = drive_wire(lambda _: np.full(4, 5.0), ACSAR, seconds)
        findings = {finding.name: finding for finding in identify_logs([log], ACSAR).findings}
        assert findings["firmware.feedback_rate"].told == told


@pytest.mark.parametrize("window", [0.005, 0.1])
def test_identify_logs_finds_other_averaging_times(window: float) -> None:
    """The config has 50 ms, and counts that the board doesn't have."""
    encoder = {"window": window, "counts_per_revolution": 1_000_000, "quantum": None}
    robot = HIDDEN.with_(encoder=encoder, motor={"deadband": 0.0})
    result = identify_simulated(robot)
    assert find_missed_truths(result, robot) == []


def test_identify_logs_refuses_a_log_without_commands() -> None:
    with pytest.raises(ConfigError, match="holds no commands"):
        identify_logs([WireLog.of((), ())], ACSAR)


def test_merge_wheels_weighs_narrow_intervals_more() -> None:
    estimates = {0: Estimate(1.0, 0.9, 1.1), 1: Estimate(1.06, 0.86, 1.26)}
    merged = Estimate(pytest.approx(1.012), 0.86, 1.26)  # type: ignore[arg-type]
    assert merge_wheels(estimates) == {0: merged, 1: merged}

    estimates[1] = Estimate(1.4, 1.2, 1.6)
    assert merge_wheels(estimates) == estimates

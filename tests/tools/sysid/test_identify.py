"""A hidden robot, found in simulated time; and what an identification does with bad logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quirks import apply_to_config, make_link, parse_quirks
from sysid_tools import ACSAR, drive_wire, find_missed_truths, score_findings

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.physics.randomization import measured_ranges
from acsar_gym.protocol import encode
from acsar_gym.recording import Recorder, read
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.excitation import drive_excitation, plan_excitation
from acsar_gym.tools.sysid.identify import (
    Identification,
    ParameterFinding,
    identification_table,
    identify_device,
    identify_files,
    identify_logs,
)
from acsar_gym.tools.sysid.pairs import check_same_robot

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
    """The manoeuvre, recorded."""
    path = tmp_path_factory.mktemp("identified") / "manoeuvre.mcap"
    drive_excitation(open_link("planar", HIDDEN), ACSAR, 12.0, Recorder(path))
    return path


@pytest.fixture(scope="module")
def found(recording: Path) -> Identification:
    return identify_files([recording], ACSAR)


def test_a_hidden_robot_is_found_from_its_recording(found: Identification) -> None:
    for one in score_findings(found, HIDDEN):
        assert one.error <= 1.0, one
        assert one.holds, one
    assert found.held_out is not None
    assert found.held_out.after < found.held_out.before / 10.0
    assert identification_table(found).row_count == len(found.findings)


def test_the_robots_file_has_values_intervals_and_logs(
    found: Identification, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    found.robot().save(path)
    robot = RobotConfig.load(path)
    assert robot.motor.time_constant == pytest.approx(0.15, rel=0.05)
    assert robot.motor.gain == pytest.approx((0.95, 1.0, 1.05, 0.98), rel=0.01)
    assert robot.firmware.command_timeout == pytest.approx(0.6, abs=0.06)
    assert robot.encoder.quantum == pytest.approx(0.07, abs=1e-3)
    assert robot.wheel_radius == ACSAR.wheel_radius
    gain = robot.measured["motor.gain.b"]
    assert gain.low <= 1.0 <= gain.high
    assert gain.logs == found.logs
    assert len(robot.firmware.delay_samples) == 10


def test_new_findings_end_the_intervals_of_older_ones() -> None:
    def with_gains(config: RobotConfig, wheels: str) -> RobotConfig:
        gains = [
            ParameterFinding("motor.gain", w, 1.1, 1.09, 1.11, told=True) for w in wheels or [""]
        ]
        findings = (*gains, ParameterFinding("encoder.quantum"))
        return Identification(config, findings, None, (), 20.0).robot()

    first = with_gains(ACSAR, "abcd")
    assert set(first.measured) == {f"motor.gain.{wheel}" for wheel in "abcd"}
    repaired = with_gains(first, "")
    assert set(repaired.measured) == {"motor.gain"}
    assert measured_ranges(repaired)["motor_gain"] == pytest.approx((1.09 / 1.1, 1.11 / 1.1))
    assert set(with_gains(repaired, "abcd").measured) == set(first.measured)


def test_recordings_must_be_of_one_robot(recording: Path, tmp_path: Path) -> None:
    other, path = ACSAR.with_(wheel_radius=0.06), tmp_path / "other.mcap"
    with Robot(open_link("planar", other), other, recorder=Recorder(path)) as robot:
        robot.tick((1.0, 1.0, 1.0, 1.0))
    with pytest.raises(ConfigError, match=r"other\.mcap: .*wheel_radius"):
        identify_files([recording, path], None)
    calibrated = replace(read(recording), config=ACSAR.with_(wheel_radius=0.0509))
    check_same_robot([("a", read(recording)), ("b", calibrated)], "identify")


def test_a_log_without_commands_is_an_error() -> None:
    nothing = WireLog(np.empty(0), (), np.empty(0), ())
    with pytest.raises(ConfigError, match="holds no commands"):
        identify_logs([nothing], ACSAR)


@pytest.mark.parametrize(
    ("quirk", "motor", "message"),
    [
        ("backward-gain=0.85", {}, "wheel speeds are missed by"),
        ("feedback-factor=9.55", {}, "times the expected speed: likely feedback in rpm"),
        pytest.param("feedback-factor=1.5", {}, "1.4", marks=pytest.mark.slow),
        pytest.param("overshoot=0.2", {}, "are missed by", marks=pytest.mark.slow),
        pytest.param("reversal-hold=0.2", {}, "are missed by", marks=pytest.mark.slow),
        pytest.param("", {"max_speed": 6.0}, "are missed by", marks=pytest.mark.slow),
    ],
)
def test_a_board_outside_the_model_is_not_written(
    quirk: str, motor: dict[str, float], message: str
) -> None:
    found = identify_quirky(HIDDEN.with_(motor=motor), *([quirk] if quirk else []))
    assert message in found.misfit
    with pytest.raises(AcsarError, match="--anyway"):
        found.check()
    found.check(anyway=True)
    robot = found.robot()
    assert robot.motor_fit == found.verdict
    assert message in robot.misfit
    assert not robot.measured
    assert robot.motor_fit_logs == found.logs != ()


@pytest.mark.parametrize(
    "motor",
    [
        {"max_speed": 6.0},
        pytest.param({"gain": 0.6}, marks=pytest.mark.slow),
        pytest.param({"gain": (1.0, 1.6, 1.0, 1.0)}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_what_the_robots_file_contains_already_is_no_misfit(motor: dict[str, Any]) -> None:
    log = drive_excitation(open_link("planar", HIDDEN.with_(motor=motor)), ACSAR, 14.0)
    assert not identify_logs([log], ACSAR.with_(motor=motor)).misfit


@pytest.mark.parametrize(
    ("deadband", "dead"),
    [
        (20.0, ("front_right", "front_left", "rear_left", "rear_right")),
        ((20.0, 0.0, 0.0, 0.0), ("front_right",)),
        ((0.0, 0.0, 20.0, 20.0), ("rear_left", "rear_right")),
    ],
)
def test_dead_wheels_are_named_and_no_file_is_written_of_four(
    deadband: Any, dead: tuple[str, ...]
) -> None:
    found = identify_quirky(ACSAR.with_(motor={"deadband": deadband}))
    assert found.dead == dead
    assert not [
        one for one in found.findings if len(dead) == 4 and one.name[:6] == "motor." and one.told
    ]
    rate = ParameterFinding("firmware.feedback_rate", "", 50.0, 49.0, 51.0, before=100.0, told=True)
    known = replace(found, findings=(*found.findings, rate))
    if len(dead) < 4:
        known.check(anyway=True)
        return
    with pytest.raises(AcsarError, match="no wheel turned"):
        known.check(anyway=True)


def test_a_model_that_fits_says_so_in_the_robots_file(found: Identification) -> None:
    found.check()
    assert found.held_out is not None
    assert found.held_out.after < 1.3 * found.held_out.noise
    assert (found.robot().motor_fit, found.robot().misfit) == ("fits", "")


@pytest.mark.parametrize("window", [0.005, 0.1])
def test_what_was_only_configured_is_not_measured(window: float) -> None:
    """The config says 50 ms, and counts that the board doesn't have."""
    encoder = {"window": window, "counts_per_revolution": 1_000_000, "quantum": None}
    hidden = HIDDEN.with_(encoder=encoder, motor={"deadband": 0.0})
    findings = identify_quirky(hidden).findings
    true = {
        "encoder.window": window,
        "motor.deadband": 0.0,
        "firmware.command_delay": hidden.firmware.command_delay,
    }
    for one in findings:
        if one.name in true:
            assert one.told or one.name == "encoder.window", one
            assert holds(one, true[one.name]), one


@pytest.mark.parametrize(
    ("rate", "narrowed", "kept"),
    [
        (0.2, ("motor.gain", "motor.deadband"), ("motor.acceleration", "firmware.command_delay")),
        (3.0, ("motor.gain", "motor.time_constant"), ("encoder.window",)),
    ],
    ids=["slow sine", "fast sine"],
)
def test_what_a_drive_does_not_show_is_kept(
    rate: float, narrowed: tuple[str, ...], kept: tuple[str, ...]
) -> None:
    log = drive_wire(lambda time: 6.0 * np.sin(rate * time), HIDDEN, 20.0)
    found = identify_logs([log], ACSAR)
    found.check()
    assert find_missed_truths(found, HIDDEN) == []
    told = {finding.name: finding.told for finding in found.findings}
    assert all(told[name] for name in narrowed)
    for finding in found.findings:
        if finding.name in (*kept, "firmware.command_timeout"):
            assert (finding.value, finding.told) == (None, False)
            assert "not narrowed by this log: drive" in finding.note


@pytest.mark.parametrize("duration", [0.3, 2.0])
def test_what_cannot_be_told_has_no_number(duration: float) -> None:
    commands = plan_excitation(ACSAR, 20.0, 0.01).before[: round(100 * duration)]
    stamps = np.asarray(0.01 * np.arange(len(commands)), np.float64)
    lines = tuple(encode(row) for row in commands.tolist())
    found = identify_logs([WireLog(stamps, lines, stamps + 0.005, lines)], ACSAR)
    for one in found.findings:
        if one.name not in ("firmware.feedback_rate", "encoder.quantum"):
            assert (one.value, one.low, one.high, one.told) == (None, None, None, False)
            assert "s of log" in one.note
    assert found.robot().motor == found.config.motor


def identify_quirky(hidden: RobotConfig, *names: str) -> Identification:
    """Identify a hidden robot with these quirks in simulated time."""
    odd = parse_quirks(names)
    link = make_link("planar", apply_to_config(odd, hidden), odd)
    return identify_device(link, ACSAR, 14.0)


def holds(one: ParameterFinding | None, value: float) -> bool:
    """Whether an interval holds the truth, if there is one."""
    if one is None or one.low is None or one.high is None:
        return True
    return one.low <= value <= one.high

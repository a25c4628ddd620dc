"""A hidden robot, found in simulated time; and what an identification does with bad logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identification.hidden_robots import scores

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError, IdentificationError, LinkError
from acsar_gym.links import Link
from acsar_gym.physics.randomization import measured_ranges
from acsar_gym.recording import Recorder, read
from acsar_gym.recording.replay import check_same_robot
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.safety.layer import Safety
from acsar_gym.tools.sysid import excitation
from acsar_gym.tools.sysid.excitation import TappedLink, drive_excitation, plan_excitation
from acsar_gym.tools.sysid.identify import (
    Identification,
    identification_table,
    identify_device,
    identify_files,
    identify_logs,
)
from acsar_gym.tools.sysid.parameter_findings import ParameterFinding

ACSAR = RobotConfig.preset("acsar")
INTERVAL = {"low": 0.4, "high": 0.6, "method": "identify"}
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
    for one in scores(found, HIDDEN):
        assert one.error <= 1.0, one
        assert one.holds, one


def test_the_fit_predicts_what_it_did_not_see(found: Identification) -> None:
    assert found.held_out is not None
    assert found.held_out.after < found.held_out.before / 10.0


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


def test_wheels_that_do_not_differ_share_one_number(found: Identification) -> None:
    wheels: dict[str, list[str]] = {name: [] for name in ("motor.time_constant", "motor.gain")}
    for one in found.findings:
        if one.name in wheels:
            wheels[one.name].append(one.wheel)
    assert wheels == {"motor.time_constant": [""], "motor.gain": ["a", "b", "c", "d"]}


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


def test_a_board_without_a_time_out_has_no_interval_of_one() -> None:
    known = ACSAR.with_(measured={"firmware.command_timeout": INTERVAL})
    findings = (
        ParameterFinding("firmware.command_timeout", told=True),
        ParameterFinding("encoder.quantum"),
    )
    robot = Identification(known, findings, None, (), 20.0).robot()
    assert (robot.firmware.command_timeout, robot.measured) == (None, {})


def test_the_table_has_a_row_for_each_finding(found: Identification) -> None:
    assert identification_table(found).row_count == len(found.findings)


def test_recordings_of_different_robots_are_one_error(recording: Path, tmp_path: Path) -> None:
    other, path = ACSAR.with_(wheel_radius=0.06), tmp_path / "other.mcap"
    with Robot(open_link("planar", other), other, recorder=Recorder(path)) as robot:
        robot.tick((1.0, 1.0, 1.0, 1.0))
    with pytest.raises(ConfigError, match=r"other\.mcap: is of another robot: wheel_radius"):
        identify_files([recording, path], None)


def test_a_calibrated_robot_is_the_same_robot(recording: Path, tmp_path: Path) -> None:
    after = replace(read(recording), config=ACSAR.with_(wheel_radius=0.0509))
    check_same_robot([("a", read(recording)), ("b", after)], "identify")


def test_a_log_without_commands_is_an_error() -> None:
    nothing = WireLog(np.empty(0), (), np.empty(0), ())
    with pytest.raises(ConfigError, match="holds no commands"):
        identify_logs([nothing], ACSAR)


@pytest.mark.parametrize("duration", [1.0, 1e9, float("nan")])
def test_the_duration_of_a_manoeuvre_is_checked(duration: float) -> None:
    with pytest.raises(ConfigError, match="must be 12 to 600 s"):
        identify_device(open_link("planar", ACSAR), ACSAR, duration)


class FailingLink(TappedLink):
    """A link that is lost after a while, and remembers what was sent."""

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self.left = 300
        self.closed = False

    def advance(self, period: float) -> bytes:
        self.left -= 1
        if not self.left:
            raise LinkError("lost", "plug it in")
        return super().advance(period)

    def close(self) -> None:
        self.closed = True
        super().close()


def test_a_link_that_is_lost_ends_the_manoeuvre_with_zeros() -> None:
    link = FailingLink(open_link("planar", ACSAR))
    with pytest.raises(LinkError, match="lost"):
        drive_excitation(link, ACSAR, 12.0)
    assert link.closed
    assert link.log.sent[-1].startswith(b"ap00.00,bp00.00,cp00.00,dp00.00")


def test_a_fit_that_explains_little_is_not_written(found: Identification) -> None:
    found.check()
    assert found.held_out is not None
    poor = replace(found, held_out=replace(found.held_out, after=0.4 * found.held_out.signal))
    with pytest.raises(IdentificationError, match="nothing to write: the fit misses"):
        poor.check()


@pytest.mark.parametrize(
    ("reason", "said"), [("estop", "an emergency stop after 0.5"), ("fence", "the geofence after")]
)
def test_a_manoeuvre_ends_with_a_stop(reason: str, said: str) -> None:
    class Stopping(TappedLink):
        """Stops the robot after half a second."""

        def advance(self, period: float) -> bytes:
            data = super().advance(period)
            if reason == "estop" and self.now() - begun[0] > 0.5:
                Safety.estop(made[0])
            return data

    config = ACSAR
    if reason == "fence":
        config = ACSAR.with_(geofence={"min_x": -0.02, "max_x": 0.02})
    link, begun, made = Stopping(open_link("planar", config)), [0.0], []
    whole = plan_excitation(config, 12.0, 0.01)
    with Robot(link, config) as robot:
        made.append(robot.safety)
        begun[0] = link.now()
        with pytest.raises(LinkError, match=f"ended by {said}"):
            excitation._drive(robot, whole)

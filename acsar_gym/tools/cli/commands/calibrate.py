"""The command `calibrate`."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.commands.identify import FoundRobotOptions, FoundRobotOutputs
from acsar_gym.tools.cli.options import (
    HostOptions,
    check_not_given,
    check_writable,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.calibration import CalibrationRun, GivenReadings
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|all"),
]
Numbers = Annotated[tuple[float, ...], tyro.conf.arg(metavar="N [N ...]")]
USUAL_SPEED_SHARE = 0.6
"""Speed where none is given, as a share of the robot's largest."""
TURN_RATE_SHARES = (0.4, 0.8)
"""Turn rates where neither rates nor readings are given, as shares of the robot's largest."""


@dataclass(frozen=True)
class RunOptions:
    """What is driven, on which floor, and what was measured.

    Straight lines tell the wheels' mean radius; turns wheel_separation_multiplier and
    body.turn_factor.
    """

    distance: float = 2.0
    """Length of each straight run, by odometry [m]."""
    measured: Numbers = ()
    """Measured straight distances from start to end, one for each run [m]; positive, backwards
    runs as well."""
    aside: Numbers = ()
    """How far to the left of the line ahead each straight run ended [m], negative to the right;
    tells left against right radius."""
    turns: float = 5.0
    """Full turns of each turning run, by odometry; left and right alternate."""
    measured_deg: Numbers = ()
    """Measured angles, one for each turning run [degrees], full turns counted; right turns positive
    or negative."""
    speeds: Numbers = ()
    """Turn rates [rad/s]; default: 40 % and 80 % of what max_angular and max_linear allow, or 60 %
    where readings are given."""
    radii: Numbers = (0.0,)
    """Radii of the circles that the robot's centre drives [m]; 0 turns in place. Circles to both
    sides also tell left against right radius."""
    space: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None
    """Free floor ahead of the robot's centre, and to each of its sides [m]. Needed for a real
    robot, which is stopped at its edge."""
    repeats: int | None = None
    """Runs of each kind; default: as many as readings, else 3 straight lines, 1 turn of each speed
    and radius."""
    yes: bool = False
    """Don't ask before driving, for scripts."""

    def readings(self) -> GivenReadings:
        """Return the readings."""
        from acsar_gym.tools.sysid.calibration import GivenReadings  # noqa: PLC0415

        return GivenReadings(self.measured, self.aside, self.measured_deg)

    def plans(self, manoeuvre: Manoeuvre, config: RobotConfig) -> list[RunPlan]:
        """The runs of a manoeuvre, or of both: as many as readings, or as asked for."""
        from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

        if self.repeats is not None and self.repeats < 1:
            raise ConfigError(f"--repeats {self.repeats}: must be 1 or more")
        plans = []
        if manoeuvre != "turn":
            speed = USUAL_SPEED_SHARE * config.max_linear
            repeats = self.repeats or len(self.measured) or 3
            plans += calibration_drive.plan_straights(self.distance, speed, repeats)
        if manoeuvre != "straight":
            shares = (USUAL_SPEED_SHARE,) if self.measured_deg else TURN_RATE_SHARES
            top = min(config.max_angular, config.max_linear / max(*self.radii, 1e-9))
            speeds = self.speeds or tuple(share * top for share in shares)
            for speed in speeds:
                _check_speed("--speeds", speed, config.max_angular, field="max_angular")
                fastest = max(speed * max(self.radii, default=0.0), 1e-9)
                _check_speed(
                    "--speeds times --radii", fastest, config.max_linear, field="max_linear"
                )
            kinds = max(1, len(speeds) * len(self.radii))
            repeats = self.repeats or max(1, len(self.measured_deg) // kinds)
            plans += calibration_drive.plan_turns(self.turns, speeds, self.radii, repeats)
        return plans


def _check_speed(option: str, value: float, limit: float, field: str) -> None:
    if not 0.0 < value <= limit:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field} = {limit:g}")


@command("calibrate", "robots", drives=True)
def calibrate_robot(
    device: Device,
    manoeuvre: Manoeuvre,
    runs: RunOptions,
    setup: FoundRobotOptions,
    host: HostOptions,
    output: FoundRobotOutputs,
) -> int:
    """Measure wheel radii and turning on the floor, and write them into the robot's file.

    The robot drives within --space, and you measure with a tape where the point below its centre
    ended. Record the runs with --record FILE, then give FILE as DEVICE with the readings:
    --measured, --aside, --measured-deg. In simulation the truth measures.

    Args:
        device: serial device, planar, bullet, mujoco; or a recording of runs that were driven
            before, to give readings to.
        manoeuvre: what to drive.
        runs: how it is driven, and readings.
        setup: the robot, and recording.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results.
    """
    from acsar_gym.recording import read  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration  # noqa: PLC0415

    check_writable(output.json, robot=output.out, force=output.force)
    if not device.endswith(".mcap"):
        return _drive_and_finish(device, manoeuvre, runs, setup=setup, host=host, output=output)

    check_not_given((("--twin", setup.twin), ("--record", setup.record)))
    recording = read(Path(device))
    config = recording.config if setup.robot is None else RobotConfig.of(setup.robot)
    given = runs.readings()
    recorded = calibration.read_recorded_runs(Path(device), manoeuvre, config)
    given.check([run.manoeuvre for run in recorded])
    in_ros = any(episode.wire.stamped for episode in recording.episodes)
    return _finish_calibration(given.give(recorded), config, output, in_ros=in_ros)


def _drive_and_finish(
    device: str,
    manoeuvre: Manoeuvre,
    options: RunOptions,
    *,
    setup: FoundRobotOptions,
    host: HostOptions,
    output: FoundRobotOutputs,
) -> int:
    """Drive the runs; returns the exit code."""
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.robot import Robot  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

    simulated = device in BODIES
    config = RobotConfig.of(setup.robot)
    plans = options.plans(manoeuvre, config)
    given = options.readings()
    if not (given.check([plan.manoeuvre for plan in plans]) or simulated or setup.record):
        raise ConfigError(
            "nobody would measure: add --record FILE and give the readings later, or give "
            "--measured or --measured-deg"
        )
    link = open_link(device, setup.driven(config, device))
    host.prepare(device)
    recorder = setup.recorder("calibrate", link=device)
    runs: list[CalibrationRun] = []

    def finish() -> int:
        record = setup.record
        return _finish_calibration(
            given.give(runs), config, output, in_ros=link.stamped, record=record
        )

    try:
        calibration_drive.drive_plans(
            Robot(link, config, recorder=recorder),
            plans,
            options.space,
            runs=runs,
            announce=lambda plan: _announce_run(device, options, plan, simulated=simulated),
            recorder=recorder,
            reads_truth=simulated and not given.measured and not given.degrees,
        )
    except LinkError:
        if runs:
            say(f"{len(runs)} finished runs are used")
            with contextlib.suppress(ConfigError):  # too few; what ended them counts more
                finish()
        raise
    return finish()


def _finish_calibration(
    runs: Sequence[CalibrationRun],
    config: RobotConfig,
    output: FoundRobotOutputs,
    *,
    in_ros: bool,
    record: Path | None = None,
) -> int:
    """Fit, print and write; returns the exit code."""
    from acsar_gym.tools.sysid import calibration_fit  # noqa: PLC0415

    if not any(run.readings for run in runs):
        print_results(json=output.json, data=calibration_fit.format_calibration(None, runs, config))
        hint = "no run has a reading: nothing was found"
        if record is not None:
            hint += f"; give them later: acsar-gym calibrate {record} all --measured ..."
        say(hint)
        if output.out is not None:
            say(f"{output.out} isn't written: there are no readings yet")
        return 0

    fit = calibration_fit.fit_geometry(runs, config)
    print_results(
        calibration_fit.runs_table(fit, config),
        calibration_fit.calibration_table(fit, config),
        json=output.json,
        data=calibration_fit.format_calibration(fit, runs, config),
    )
    if output.out is None:
        return 0
    calibrated = calibration_fit.make_calibrated_config(fit, config, in_ros=in_ros)
    calibrated.save(output.out, force=output.force)
    say(f"written: {output.out}; use it with --robot {output.out}")
    if in_ros:
        say(
            "its controller takes twists by its own radii and separation, which are in ros2 of the "
            "file. Better set the found ones in its parameters and delete wheel_radii and "
            "wheel_separation from ros2"
        )
    return 0


def _announce_run(device: str, options: RunOptions, plan: RunPlan, *, simulated: bool) -> None:
    """Wait until a real robot is in its place; say what is driven."""
    say(f"{plan.name} ...")
    if simulated:
        return
    if sys.stdin.isatty() and not options.yes:
        x, y = options.space or (0.0, 0.0)
        place = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        room = f"with {x:g} m free ahead and {y:g} m to each side"
        with contextlib.suppress(EOFError):
            input(f"note where it ended, {place}, {room}, then press Enter: ")
    countdown(f"{device}: the robot will drive: {plan.name}", yes=options.yes)

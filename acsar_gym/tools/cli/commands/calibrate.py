"""The command `calibrate`."""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, LinkError, escape_unprintable
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
    from acsar_gym.tools.sysid.calibration import CalibrationJob
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
                _check_speed("--speeds", speed, config.max_angular, "max_angular")
                fastest = max(speed * max(self.radii, default=0.0), 1e-9)
                _check_speed("--speeds times --radii", fastest, config.max_linear, "max_linear")
            kinds = max(1, len(speeds) * len(self.radii))
            repeats = self.repeats or max(1, len(self.measured_deg) // kinds)
            plans += calibration_drive.plan_turns(self.turns, speeds, self.radii, repeats)
        return plans


def _check_speed(option: str, value: float, most: float, field: str) -> None:
    """Raise ConfigError unless 0 < value <= most."""
    if not 0.0 < value <= most:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field} = {most:g}")


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
    ended: it asks after each run (in scripts: --measured, --aside, --measured-deg; or --record FILE
    now, and FILE as DEVICE with the readings later). Lengths are positive; right turns are positive
    or negative. In simulation the truth measures.

    Args:
        device: serial device, planar, bullet, mujoco; or a recording of runs that were driven
            before, to give readings to.
        manoeuvre: what to drive.
        runs: how it is driven, and readings.
        setup: the robot, and recording.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.recording import read  # noqa: PLC0415
    from acsar_gym.robot import Robot  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration, calibration_drive  # noqa: PLC0415

    check_writable(output.json, robot=output.out, force=output.force)
    recorded, simulated = device.endswith(".mcap"), device in BODIES
    if recorded:
        driving = (("--twin", setup.twin), ("--record", setup.record))
        check_not_given(driving)
    recording = read(Path(device)) if recorded else None
    if recording is not None and setup.robot is None:
        config = recording.config
    else:
        config = RobotConfig.of(setup.robot)
    ask = _ask_reading if sys.stdin.isatty() else None
    given = calibration.check_given_readings(runs.measured, runs.aside, runs.measured_deg)
    job = calibration.CalibrationJob(config, given, ask)
    if recording is not None:
        job.in_ros = any(episode.wire.stamped for episode in recording.episodes)
        job.runs = calibration.read_recorded_runs(Path(device), manoeuvre, config)
        job.check_given(Counter(run.manoeuvre for run in job.runs))
        return _finish_calibration(job, output)
    link = open_link(device, setup.driven(config, device))
    job.in_ros = link.stamped
    host.prepare(device)
    recorder = setup.recorder("calibrate", link=device)
    robot = Robot(link, config, recorder=recorder)
    plans = runs.plans(manoeuvre, config)

    def announce(plan: RunPlan) -> None:
        _announce_run(device, runs, plan, simulated=simulated)

    try:
        calibration_drive.drive_plans(job, robot, plans, runs.space, announce, recorder)
    except LinkError:
        if job.runs:
            say(f"{len(job.runs)} finished runs are used")
            with contextlib.suppress(ConfigError):  # too few; what ended them counts more
                _finish_calibration(job, output)
        raise
    return _finish_calibration(job, output, setup.record)


def _finish_calibration(
    job: CalibrationJob, output: FoundRobotOutputs, record: Path | None = None
) -> int:
    """Read, fit, print and write; returns the exit code."""
    from acsar_gym.tools.sysid import calibration_fit  # noqa: PLC0415

    config = job.config
    job.finish()
    if not any(run.readings for run in job.runs):
        print_results(
            json=output.json, data=calibration_fit.format_calibration(None, job.runs, config)
        )
        hint = "no run has a reading: nothing was found"
        if record is not None:
            hint += f"; give them later: acsar-gym calibrate {record} all --measured ..."
        say(hint)
        if output.out is not None:
            say(f"{output.out} isn't written: there are no readings yet")
        return 0
    fit = calibration_fit.fit_geometry(job.runs, config)
    print_results(
        calibration_fit.runs_table(job.runs, fit, config),
        calibration_fit.calibration_table(fit, config),
        json=output.json,
        data=calibration_fit.format_calibration(fit, job.runs, config),
    )
    if output.out is not None:
        found = calibration_fit.make_calibrated_config(fit, config, in_ros=job.in_ros)
        found.save(output.out, force=output.force)
        say(f"written: {output.out}; use it with --robot {output.out}")
        if job.in_ros:
            say(
                "its controller takes twists by its own radii and separation, which are in ros2 of "
                "the file. Better set the found ones in its parameters and delete wheel_radii and "
                "wheel_separation from ros2"
            )
    return 0


def _announce_run(device: str, run: RunOptions, plan: RunPlan, *, simulated: bool) -> None:
    """Ask before a real robot drives; say what is driven."""
    asks = sys.stdin.isatty() and not run.yes
    if not (simulated or run.yes or asks):
        countdown(f"{device}: the robot would drive", yes=False)  # says to add --yes
    say(f"{plan.name} ...")
    if simulated:
        return
    if asks:
        x, y = run.space or (0.0, 0.0)
        start = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        room = f"with {x:g} m free ahead and {y:g} m to each side"
        _ask_reading(f"{start}, {room}, then press Enter")
    countdown(f"{device}: the robot will drive: {plan.name}", yes=run.yes)


def _ask_reading(question: str) -> str:
    """Ask on the terminal; an end of the input is an empty answer."""
    try:
        return input(f"{escape_unprintable(question)}: ")
    except EOFError:
        return ""

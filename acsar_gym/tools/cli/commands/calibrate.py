"""The command `calibrate`."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.commands.identify import FoundRobotOptions, FoundRobotOutputs
from acsar_gym.tools.cli.options import (
    check_stoppable,
    check_writable,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.calibration import CalibrationRun
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|all"),
]
Numbers = Annotated[tuple[float, ...], tyro.conf.arg(metavar="N [N ...]")]
SPEED_SHARE = 0.6
"""Usual speed, as a share of the robot's largest."""
TURN_RATE_SHARES = (0.4, 0.8)
"""Usual turn rates without readings, as shares of the robot's largest."""


@dataclass(frozen=True)
class RunOptions:
    """What is driven, on which floor, and what was measured.

    Straight lines determine the wheels' mean radius, turns wheel_separation_multiplier and
    body.turn_factor.
    """

    distance: float = 2.0
    """Length of each straight run, by odometry [m]."""
    measured: Numbers = ()
    """Measured straight distances from start to end, one for each run [m]. They are positive,
    also of backward runs."""
    aside: Numbers = ()
    """How far to the left of the line ahead each straight run ended [m], negative to the right.
    This determines left against right radius."""
    turns: float = 5.0
    """Full turns of each turning run, by odometry. Left and right alternate."""
    measured_deg: Numbers = ()
    """Measured angles, one for each turning run [degrees], full turns counted. Right turns
    may be positive or negative."""
    speeds: Numbers = ()
    """Turn rates [rad/s]. Default: 40 % and 80 % of what max_angular and max_linear allow, or 60 %
    if readings are given."""
    radii: Numbers = (0.0,)
    """Radii of the circles that the robot's centre drives [m]. 0 turns in place. Circles to both
    sides also determine left against right radius."""
    space: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None
    """Free floor ahead of the robot's centre, and to each of its sides [m]. Needed for a real
    robot, which is stopped at its edge."""
    repeats: int | None = None
    """Runs of each kind. Default: as many as readings, else 3 straight lines, 1 turn of each speed
    and radius."""
    yes: bool = False
    """Don't ask before driving, for scripts."""

    def plan(self, manoeuvre: Manoeuvre, config: RobotConfig) -> list[RunPlan]:
        """Plan the runs: as many as there are readings, or `repeats`."""
        from acsar_gym.tools.sysid.calibration_drive import (
            plan_straights,
            plan_turns,
        )

        plans = []
        if self.repeats is not None:
            _check_number("--repeats", self.repeats, 1000.0)
        if manoeuvre != "turn":
            repeats = self.repeats or len(self.measured) or 3
            plans += plan_straights(self.distance, SPEED_SHARE * config.max_linear, repeats)
        if manoeuvre == "straight":
            return plans

        largest = max(*self.radii, 1e-9)
        fastest = min(config.max_angular, config.max_linear / largest)
        shares = (SPEED_SHARE,) if self.measured_deg else TURN_RATE_SHARES
        speeds = self.speeds or tuple(share * fastest for share in shares)
        for speed in speeds:
            _check_number("--speeds", speed, config.max_angular, "max_angular = ")
            _check_number("--speeds times --radii", speed * largest, config.max_linear)
        kinds = max(1, len(speeds) * len(self.radii))
        repeats = self.repeats or max(1, len(self.measured_deg) // kinds)
        return plans + plan_turns(self.turns, speeds, self.radii, repeats)


def _check_number(option: str, value: float, limit: float, field: str = "") -> None:
    if not 0.0 < value <= limit:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field}{limit:g}")


@command("calibrate", drives=True)
def calibrate_robot(
    device: Device,
    manoeuvre: Manoeuvre,
    runs: RunOptions,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
) -> int:
    """Measure wheel radii and turning on the floor, and write them into the robot's file.

    The robot drives within --space, and you measure with a tape where the point below its centre
    ended. Record the runs with --record FILE, then give FILE as DEVICE with the readings:
    --measured, --aside, --measured-deg. In simulation the truth measures.

    Args:
        device: Serial device, planar, bullet, mujoco, or a recording of runs that were driven
            before, to give readings to.
        manoeuvre: What to drive.
        runs: How it is driven, and readings.
        setup: The robot, and recording.
        output: Results.
    """
    from acsar_gym.recording import read
    from acsar_gym.tools.sysid import calibration

    check_writable(output.json, robot=output.out)
    readings = calibration.GivenReadings(runs.measured, runs.aside, runs.measured_deg)
    if not device.endswith(".mcap"):
        return _drive_and_finish(device, manoeuvre, runs, readings, setup=setup, output=output)

    setup.check_recorded()
    recording = read(Path(device))
    config = recording.config if setup.robot is None else RobotConfig.of(setup.robot)
    recorded = calibration.read_recorded_runs(Path(device), manoeuvre, config)
    readings.check([run.manoeuvre for run in recorded])
    in_ros = any(episode.wire.stamped for episode in recording.episodes)
    return _finish_calibration(readings.give(recorded), config, output, in_ros=in_ros)


def _drive_and_finish(
    device: str,
    manoeuvre: Manoeuvre,
    options: RunOptions,
    readings: Any,
    *,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
) -> int:
    """Drive the runs. Returns the exit code."""
    from acsar_gym.links import open_link
    from acsar_gym.robot import Robot
    from acsar_gym.tools.sysid.calibration_drive import drive_plans

    config = RobotConfig.of(setup.robot)
    plans = options.plan(manoeuvre, config)
    link = open_link(device, setup.driven(config, device))
    has_readings = readings.check([plan.manoeuvre for plan in plans])
    if not (has_readings or setup.record or not link.is_real):
        raise ConfigError(
            "nobody would measure: add --record FILE and give the readings later, or give "
            "--measured or --measured-deg"
        )
    check_stoppable(device)
    recorder = setup.recorder("calibrate", link=device)
    runs: list[CalibrationRun] = []
    try:
        drive_plans(
            Robot(link, config, recorder=recorder),
            plans,
            options.space,
            runs=runs,
            announce=lambda plan: _announce_run(device, options, plan, is_real=link.is_real),
            recorder=recorder,
            reads_truth=not link.is_real and not has_readings,
        )
    except LinkError:
        if runs:
            say(f"{len(runs)} finished runs are used")
            with contextlib.suppress(ConfigError):  # too few runs: the LinkError is reported
                _finish_calibration(readings.give(runs), config, output, in_ros=link.stamped)
        raise
    measured = readings.give(runs)
    return _finish_calibration(measured, config, output, in_ros=link.stamped, record=setup.record)


def _finish_calibration(
    runs: Sequence[CalibrationRun],
    config: RobotConfig,
    output: FoundRobotOutputs,
    *,
    in_ros: bool,
    record: Path | None = None,
) -> int:
    """Fit, print and write. Returns the exit code."""
    from acsar_gym.tools.sysid import calibration_fit

    if not any(run.readings for run in runs):
        print_results(json=output.json, data=calibration_fit.format_calibration(None, runs, config))
        later = f"; give them later: acsar-gym calibrate {record} all --measured ..."
        say(f"no run has a reading: nothing was found{later if record else ''}")
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
    output.write(calibration_fit.make_calibrated_config(fit, config, in_ros=in_ros))
    if in_ros:
        say(
            "its controller converts twists with its own radii and separation, which are in ros2 "
            "of the file. Better set the found values in its parameters and delete wheel_radii "
            "and wheel_separation from ros2"
        )
    return 0


def _announce_run(device: str, options: RunOptions, plan: RunPlan, *, is_real: bool) -> None:
    """Announce a run, and wait until a real robot is in its place."""
    say(f"{plan.name} ...")
    if not is_real:
        return
    if sys.stdin.isatty() and not options.yes:
        x, y = options.space or (0.0, 0.0)
        place = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        room = f"with {x:g} m free ahead and {y:g} m to each side"
        with contextlib.suppress(EOFError):
            input(f"note where it ended, {place}, {room}, then press Enter: ")
    countdown(f"{device}: the robot will drive: {plan.name}", yes=options.yes)

"""Options of `acsar-gym calibrate`, and the runs that they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.calibrate import GivenReadings
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

Numbers = Annotated[tuple[float, ...], tyro.conf.arg(metavar="N [N ...]")]
USUAL_SPEED_SHARE = 0.6
"""Speed where none is given, as a share of the robot's largest."""
TURN_RATE_SHARES = (0.4, 0.8)
"""Turn rates where neither rates nor readings are given, as shares of the robot's largest."""


@dataclass(frozen=True)
class StraightOptions:
    """Straight lines: tell the wheels' mean radius."""

    distance: float = 2.0
    """Length of each run, by odometry [m]."""
    measured: Numbers = ()
    """Measured straight distances from start to end, one for each run [m]; positive, backwards
    runs as well."""
    aside: Numbers = ()
    """How far to the left of the line ahead each run ended [m], negative to the right; tells left
    against right radius."""


@dataclass(frozen=True)
class TurnOptions:
    """Turns: tell wheel_separation_multiplier and body.turn_factor."""

    turns: float = 5.0
    """Full turns of each run, by odometry; left and right alternate."""
    measured_deg: Numbers = ()
    """Measured angles, one for each run [degrees], full turns counted; right turns positive or
    negative."""
    speeds: Numbers = ()
    """Turn rates [rad/s]; default: 40 % and 80 % of max_angular, or 60 % where readings are
    given."""
    radii: Numbers = (0.0,)
    """Radii of the circles that the robot's centre drives [m]; 0 turns in place. Circles to both
    sides also tell left against right radius."""


@dataclass(frozen=True)
class SquareOptions:
    """Squares (UMBmark, Borenstein and Feng 1996): tell both sides' radii, and the multiplier."""

    size: float = 1.0
    """Length of a side [m]; larger is finer."""
    corners: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="CW.CSV CCW.CSV")] = None
    """Where clockwise and counter-clockwise runs ended: a row for each run, x,y[,degrees], in m in
    the frame of its start: x ahead, y to the left."""


@dataclass(frozen=True)
class RunOptions:
    """How runs are driven, and on which floor."""

    space: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None
    """Free floor ahead of the robot's centre, and to each of its sides [m]. Needed for a real
    robot, which is stopped at its edge."""
    speed: float | None = None
    """Linear speed [m/s]; default: 60 % of max_linear."""
    repeats: int | None = None
    """Runs of each kind; default: as many as readings, else 3 straight lines, 1 turn of each speed
    and radius, 2 squares each way."""
    yes: bool = False
    """Don't ask before driving, for scripts."""

    def linear(self, config: RobotConfig) -> float:
        """Linear speed [m/s]."""
        speed = USUAL_SPEED_SHARE * config.max_linear if self.speed is None else self.speed
        return _check_speed("--speed", speed, config.max_linear, "max_linear")


_flat = tyro.conf.arg(name="")


@dataclass(frozen=True)
class Manoeuvres:
    """What is driven."""

    straight: Annotated[StraightOptions, _flat] = StraightOptions()
    turn: Annotated[TurnOptions, _flat] = TurnOptions()
    square: Annotated[SquareOptions, _flat] = SquareOptions()

    def given(self) -> GivenReadings:
        """The readings among the options. ConfigError for files that can't be read."""
        from acsar_gym.tools.sysid.calibrate import GivenReadings, read_corners  # noqa: PLC0415

        files = self.square.corners
        clockwise, counter = (tuple(read_corners(one)) for one in files) if files else ((), ())
        straight, degrees = self.straight, self.turn.measured_deg
        return GivenReadings(straight.measured, straight.aside, degrees, clockwise, counter)

    def plans(
        self, name: str, config: RobotConfig, run: RunOptions, given: GivenReadings
    ) -> list[RunPlan]:
        """The runs of a manoeuvre, or of all three: as many as readings, or as asked for."""
        from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

        if run.repeats is not None and run.repeats < 1:
            raise ConfigError(f"--repeats {run.repeats}: must be 1 or more")
        straight, turn, square = self.straight, self.turn, self.square
        found = []
        if name in ("straight", "all"):
            repeats = run.repeats or len(straight.measured) or 3
            linear = run.linear(config)
            found += calibration_drive.plan_straights(straight.distance, linear, repeats)
        if name in ("turn", "all"):
            shares = (USUAL_SPEED_SHARE,) if turn.measured_deg else TURN_RATE_SHARES
            speeds = turn.speeds or tuple(share * config.max_angular for share in shares)
            for speed in speeds:
                _check_speed("--speeds", speed, config.max_angular, "max_angular")
                fastest = max(speed * max(turn.radii, default=0.0), 1e-9)
                _check_speed("--speeds times --radii", fastest, config.max_linear, "max_linear")
            kinds = max(1, len(speeds) * len(turn.radii))
            repeats = run.repeats or max(1, len(turn.measured_deg) // kinds)
            found += calibration_drive.plan_turns(turn.turns, speeds, turn.radii, repeats)
        if name in ("square", "all"):
            counts = [run.repeats or 2] * 2
            if square.corners is not None:
                counts = [len(given.clockwise), len(given.counter)]
            found += calibration_drive.plan_squares(
                square.size, run.linear(config), USUAL_SPEED_SHARE * config.max_angular, *counts
            )
        return found


def _check_speed(option: str, value: float, most: float, field: str) -> float:
    """Return the value; ConfigError unless 0 < value <= most."""
    if not 0.0 < value <= most:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field} = {most:g}")
    return value

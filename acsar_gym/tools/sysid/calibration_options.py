"""Options of `acsar-gym calibrate`, and the runs that they ask for."""

from __future__ import annotations

from collections.abc import Sequence
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

    def plans(self, config: RobotConfig, run: RunOptions) -> list[RunPlan]:
        """The straight runs."""
        from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

        repeats = run.times(len(self.measured) or 3)
        return calibration_drive.plan_straights(self.distance, run.linear(config), repeats)


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

    def plans(self, config: RobotConfig, run: RunOptions) -> list[RunPlan]:
        """The turns: every speed with every radius."""
        from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

        shares = (USUAL_SPEED_SHARE,) if self.measured_deg else TURN_RATE_SHARES
        speeds = self.speeds or tuple(share * config.max_angular for share in shares)
        for speed in speeds:
            _within("--speeds", speed, config.max_angular, "max_angular")
            fastest = speed * max(self.radii, default=0.0)
            _within("--speeds times --radii", max(fastest, 1e-9), config.max_linear, "max_linear")
        kinds = len(speeds) * len(self.radii)
        repeats = run.times(max(1, len(self.measured_deg) // max(1, kinds)))
        return calibration_drive.plan_turns(self.turns, speeds, self.radii, repeats)


@dataclass(frozen=True)
class SquareOptions:
    """Squares (UMBmark, Borenstein and Feng 1996): tell both sides' radii, and the multiplier."""

    size: float = 1.0
    """Length of a side [m]; larger is finer."""
    corners: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="CW.CSV CCW.CSV")] = None
    """Where clockwise and counter-clockwise runs ended: a row for each run, x,y[,degrees], in m in
    the frame of its start: x ahead, y to the left."""

    def plans(
        self, config: RobotConfig, run: RunOptions, ends: tuple[Sequence[object], Sequence[object]]
    ) -> list[RunPlan]:
        """The squares: as many of each direction as `ends` were read, or as asked for."""
        from acsar_gym.tools.sysid import calibration_drive  # noqa: PLC0415

        counts = [run.times(2)] * 2 if self.corners is None else [len(one) for one in ends]
        rate = USUAL_SPEED_SHARE * config.max_angular
        return calibration_drive.plan_squares(
            self.size, run.linear(config), rate, counts[0], counts[1]
        )


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

    def times(self, usual: int) -> int:
        """Runs of each kind; as usual where it isn't said. ConfigError for less than one."""
        if self.repeats is not None and self.repeats < 1:
            raise ConfigError(f"--repeats {self.repeats}: must be 1 or more")
        return usual if self.repeats is None else self.repeats

    def linear(self, config: RobotConfig) -> float:
        """Linear speed [m/s]."""
        speed = USUAL_SPEED_SHARE * config.max_linear if self.speed is None else self.speed
        return _within("--speed", speed, config.max_linear, "max_linear")


_flat = tyro.conf.arg(name="")


@dataclass(frozen=True)
class Manoeuvres:
    """What is driven."""

    straight: Annotated[StraightOptions, _flat] = StraightOptions()
    turn: Annotated[TurnOptions, _flat] = TurnOptions()
    square: Annotated[SquareOptions, _flat] = SquareOptions()

    def given(self) -> GivenReadings:
        """The readings among the options. ConfigError for files that can't be read."""
        from acsar_gym.tools.sysid.calibrate import (  # noqa: PLC0415
            GivenReadings,
            read_corners,
        )

        files = self.square.corners
        clockwise, counter = map(read_corners, files) if files else ([], [])
        straight, degrees = self.straight, self.turn.measured_deg
        ends = tuple(clockwise), tuple(counter)
        return GivenReadings(straight.measured, straight.aside, degrees, *ends)

    def plans(
        self, name: str, config: RobotConfig, run: RunOptions, given: GivenReadings
    ) -> list[RunPlan]:
        """The runs of a manoeuvre, or of all three."""
        found = []
        if name in ("straight", "all"):
            found += self.straight.plans(config, run)
        if name in ("turn", "all"):
            found += self.turn.plans(config, run)
        if name in ("square", "all"):
            found += self.square.plans(config, run, (given.clockwise, given.counter))
        return found


def _within(option: str, value: float, most: float, field: str) -> float:
    """Return the value; ConfigError unless 0 < value <= most."""
    if not 0.0 < value <= most:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field} = {most:g}")
    return value

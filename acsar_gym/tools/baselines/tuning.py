"""Constants of the baselines: in units of the robot, and what a search found for a robot and an id.

A baseline's constants are a frozen dataclass whose defaults are meant for any robot. Lengths are in
radii of the disc around the footprint, speeds in top speeds, and costs that compare ways are in
seconds at top speed, so that a robot twice as large and four times as fast needs no other numbers.

`tuned.json` has what agents/tune_baselines.py found for the presets, with the worlds and the score
of each search. A robot of the same outline and top speeds uses it; any other uses the defaults.
"""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.envs.ids import strip_module
from acsar_gym.safety.rules import read_limits

TUNED = Path(__file__).with_name("tuned.json")
"""What searches found, one entry for each planner, id and robot."""
UNLIMITED = 1e3
"""Stands for an acceleration without a limit [m/s^2, rad/s^2]."""


@dataclass(frozen=True, slots=True)
class RobotUnits:
    """What the constants of the baselines are multiples of."""

    radius: float
    """Of the disc around the footprint [m]."""
    speed: float
    """Top speed [m/s]."""
    turning: float
    """Greatest yaw rate [rad/s]."""
    acceleration: float
    """Greatest acceleration, by command limits and wheels [m/s^2]."""
    spin: float
    """Greatest angular acceleration, likewise [rad/s^2]."""
    braking: float
    """Deceleration of a full stop, which the command limits don't slow down [m/s^2]."""
    lag: float
    """Mean time constant of the motors [s]."""
    period: float
    """Time between two decisions [s]."""

    @classmethod
    def of(cls, config: RobotConfig, period: float) -> RobotUnits:
        """Return the units of a robot that decides every `period` [s]."""
        motors = [config.motor.of_wheel(wheel) for wheel in range(4)]
        ramp = min(motor.acceleration for motor in motors) * config.wheel_radius
        forward = read_limits(config.linear_limits, config.max_linear).max_acceleration
        turning = read_limits(config.angular_limits, config.max_angular).max_acceleration
        return cls(
            radius=footprint.outline_radius(config.outline),
            speed=config.max_linear,
            turning=config.max_angular,
            acceleration=min(forward, ramp, UNLIMITED),
            spin=min(turning, 2.0 * ramp / config.effective_separation, UNLIMITED),
            braking=min(ramp, UNLIMITED),
            lag=sum(motor.time_constant for motor in motors) / 4.0,
            period=period,
        )

    @property
    def stopping(self) -> float:
        """Distance until a stop from top speed, after one period and the motors' lag [m]."""
        return self.speed * (self.speed / (2.0 * self.braking) + self.lag + self.period)

    def steps(self, seconds: float, step: float) -> int:
        """Number of steps of a duration [s] that are nearest to `seconds`, at least 1."""
        return max(1, math.floor(seconds / step + 0.5))


def constant(default: float, low: float, high: float) -> Any:
    """A field of a baseline's constants, with the range in which a search looks for it.

    Args:
        default: for any robot.
        low: end of the range; a range whose ends are a factor of 8 apart is searched by logarithm.
        high: the other end.
    """
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class Constants:
    """Base class of the constants of a baseline; this one has none."""

    @classmethod
    def ranges(cls) -> dict[str, tuple[float, float]]:
        """Range of each constant that can be searched, by name."""
        known = {each.name: each.metadata for each in fields(cls)}
        return {name: (known["low"], known["high"]) for name, known in known.items() if known}


AnyConstants = TypeVar("AnyConstants", bound=Constants)


@functools.cache
def read_tuned() -> list[dict[str, Any]]:
    """Read the entries of `tuned.json`."""
    entries: list[dict[str, Any]] = json.loads(TUNED.read_text(encoding="utf-8"))
    return entries


def short_id(env_id: str) -> str:
    """Name of an id without its namespace and version, such as "Barn"."""
    return strip_module(env_id).rpartition("/")[2].partition("-")[0]


def find_constants(
    kind: type[AnyConstants], planner: str, env_id: str, config: RobotConfig
) -> AnyConstants:
    """Find the constants for a robot.

    Args:
        kind: class of the constants.
        planner: name of the baseline.
        env_id: id of the env that it drives.
        config: of the robot.

    Returns:
        Those that a search found for a preset of the same outline and top speeds; otherwise the
        defaults.
    """
    for entry in read_tuned():
        if (entry["planner"], entry["id"]) == (planner, short_id(env_id)) and _is_alike(
            RobotConfig.preset(entry["robot"]), config
        ):
            return kind(**entry["constants"])
    return kind()


def _is_alike(one: RobotConfig, other: RobotConfig) -> bool:
    """Whether two robots have the same outline and top speeds."""
    return (one.outline, one.max_linear, one.max_angular) == (
        other.outline,
        other.max_linear,
        other.max_angular,
    )

"""Robots with hidden parameters: how well they are identified."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.recording.recorded import RecordedLink
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.excitation import StretchedLink
from acsar_gym.tools.sysid.identify import Identification, ParameterFinding
from acsar_gym.tools.sysid.wire_tape import WireTape

ACSAR = RobotConfig.preset("acsar")
TOLERANCES = {
    "motor.time_constant": 0.05,
    "motor.gain": 0.01,
    "motor.acceleration": 0.05,
    "motor.deadband": 0.05,
    "encoder.quantum": 0.05,
    "firmware.command_delay": 0.005,
    "firmware.command_timeout": 0.06,
}
"""Shares for lags, gains and ramps, otherwise absolute."""
RELATIVE = ("motor.time_constant", "motor.gain", "motor.acceleration")


def draw_motors(seed: int) -> RobotConfig:
    """Draw a robot whose motors and board are hidden."""
    rng = np.random.default_rng(seed)
    lag = rng.uniform(0.03, 0.3)
    lags = lag * rng.uniform(0.9, 1.1, 4) if rng.random() < 0.3 else np.full(4, lag)
    return ACSAR.with_(
        motor={
            "time_constant": tuple(lags.tolist()),
            "gain": tuple(rng.uniform(0.9, 1.1, 4).tolist()),
            "deadband": float(rng.uniform(0.0, 1.0)),
            "acceleration": float(rng.uniform(20.0, 120.0)),
        },
        firmware={
            "command_delay": float(rng.uniform(0.0, 0.04)),
            "feedback_rate": float(rng.uniform(20.0, 100.0)),
            "command_timeout": None if rng.random() < 0.2 else float(rng.uniform(0.2, 1.0)),
        },
        encoder={"quantum": float(rng.uniform(0.01, 0.12))},
    )


MISFITS: dict[str, tuple[float, float]] = {
    "backward-gain": (0.75, 0.92),
    "overshoot": (0.1, 0.4),
    "reversal-hold": (0.1, 0.3),
    "feedback-factor": (1.5, 2.0),
    "rpm": (30.0 / math.pi, 30.0 / math.pi),
    "top-speed": (5.0, 7.0),
}
"""Habits of boards that the model doesn't have, and from where to where they are drawn."""


def draw_misfit(seed: int) -> tuple[RobotConfig, tuple[str, ...]]:
    """Draw a board that the model doesn't describe: the robot, and its quirks."""
    rng = np.random.default_rng([seed, 1])
    name = tuple(MISFITS)[seed % len(MISFITS)]
    size = float(rng.uniform(*MISFITS[name]))
    hidden = draw_motors(seed)
    if name == "top-speed":
        return hidden.with_(motor={"max_speed": size}), ()
    return hidden, (f"{'feedback-factor' if name == 'rpm' else name}={size}",)


@dataclass(frozen=True)
class Score:
    """How one parameter of one robot was found."""

    name: str
    error: float
    """The largest of the wheels', as a share of the tolerance."""
    holds: bool
    """Whether all intervals hold the truth."""
    share: float = 0.0
    """The largest error as a share of its interval's half."""


def score_findings(found: Identification, truth: RobotConfig) -> Iterator[Score]:
    """Compare findings with a hidden robot."""
    for name in TOLERANCES:
        section, field = name.split(".")
        parts = []
        for one in found.findings:
            if one.name != name:
                continue
            if section == "motor":
                wheels = ["abcd".index(one.wheel)] if one.wheel else range(4)
                values = [getattr(truth.motor.of_wheel(wheel), field) for wheel in wheels]
            else:
                values = [getattr(getattr(truth, section), field)]
            parts += [score_finding(one, value) for value in values]
        errors, holds, shares = zip(*parts, strict=True)
        yield Score(name, max(errors), all(holds), max(shares))


def find_missed_truths(found: Identification, truth: RobotConfig) -> list[str]:
    """List the intervals that don't hold the truth, and what is told to be missing but isn't."""
    missed = []
    for one in (each for each in found.findings if each.told):
        section, field = one.name.split(".")
        values = [getattr(getattr(truth, section), field)]
        if section == "motor":
            wheels = ["abcd".index(one.wheel)] if one.wheel else range(4)
            values = [getattr(truth.motor.of_wheel(wheel), field) for wheel in wheels]
        for value in values:
            told = one.value is not None and one.low is not None and one.high is not None
            holds = one.low <= value <= one.high if told and value is not None else not told
            if not holds or (value is None) != (one.value is None):
                missed.append(f"{one.name}.{one.wheel} {one.low} to {one.high}, truth {value}")
    return missed


def score_finding(one: ParameterFinding, value: float | None) -> tuple[float, bool, float]:
    """Error as a share of the tolerance, whether the interval holds it, share of the half width."""
    if value is None or one.value is None:
        right = value is one.value and one.told
        return (0.0 if right else np.inf), right, 0.0
    error = abs(one.value - value)
    scale = TOLERANCES[one.name] * (value if one.name in RELATIVE else 1.0)
    if one.low is None or one.high is None:
        return error / scale, False, 0.0
    return error / scale, one.low <= value <= one.high, 2.0 * error / max(2e-9, one.high - one.low)


def drive_wire(
    speeds: Callable[[float], Any], true: RobotConfig, seconds: float, known: RobotConfig = ACSAR
) -> WireLog:
    """The wire while a robot is driven that isn't the configured one.

    `speeds`: of a time, those of all wheels or of each; None for no command [rad/s].
    """
    tape = WireTape()
    link = RecordedLink(StretchedLink(open_link("planar", true)), tape, known)
    with Robot(link, known.with_(wheel_check=False)) as robot:
        for tick in range(round(seconds / known.period)):
            asked = speeds(tick * known.period)
            if asked is None:
                robot.listen()
            else:
                robot.tick(np.broadcast_to(asked, 4).tolist())
    return tape.log

"""Robots with hidden parameters: how well they are identified."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.excitation import TapedLink
from acsar_gym.tools.sysid.identify import Identification, ParameterFinding

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
    """How a parameter of a robot was found."""

    name: str
    error: float
    """The largest of the wheels', as a share of the tolerance."""
    holds: bool
    """Whether all intervals hold the truth."""


def true_values(finding: ParameterFinding, truth: RobotConfig) -> list[float | None]:
    """The true values that a finding is about: of a wheel, of all four, or of the board."""
    section, field = finding.name.split(".")
    if section != "motor":
        return [getattr(getattr(truth, section), field)]
    wheels = ["abcd".index(finding.wheel)] if finding.wheel else range(4)
    return [getattr(truth.motor.of_wheel(wheel), field) for wheel in wheels]


def score_findings(result: Identification, truth: RobotConfig) -> Iterator[Score]:
    """Compare findings with a hidden robot."""
    for name in TOLERANCES:
        parts = [
            score_finding(finding, value)
            for finding in result.findings
            if finding.name == name
            for value in true_values(finding, truth)
        ]
        errors, holds = zip(*parts, strict=True)
        yield Score(name, max(errors), all(holds))


def find_missed_truths(result: Identification, truth: RobotConfig) -> list[str]:
    """List the findings whose intervals don't hold the truth."""
    return [
        f"{finding.name}.{finding.wheel} {finding.low} to {finding.high}, truth {value}"
        for finding in result.findings
        for value in true_values(finding, truth)
        if finding.told and not score_finding(finding, value)[1]
    ]


def score_finding(finding: ParameterFinding, value: float | None) -> tuple[float, bool]:
    """Error as a share of the tolerance, and whether the interval holds the truth."""
    if value is None or finding.value is None:
        is_right = value is finding.value and finding.told
        return (0.0 if is_right else math.inf), is_right
    scale = TOLERANCES.get(finding.name, 1.0) * (value if finding.name in RELATIVE else 1.0)
    error = abs(finding.value - value) / scale
    if finding.low is None or finding.high is None:
        return error, False
    return error, finding.low <= value <= finding.high


def drive_wire(
    speeds: Callable[[float], Any], true: RobotConfig, seconds: float, known: RobotConfig = ACSAR
) -> WireLog:
    """The wire while a robot is driven that isn't the configured robot.

    `speeds`: of a time, those of all wheels or of each [rad/s].
    """
    tape = TapedLink(open_link("planar", true))
    with Robot(tape, known.with_(wheel_check=False)) as robot:
        for tick in range(round(seconds / known.period)):
            robot.tick(np.broadcast_to(speeds(tick * known.period), 4).tolist())
    return tape.log

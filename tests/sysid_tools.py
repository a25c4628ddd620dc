"""Robots with hidden parameters: how well they are identified."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from boards import apply_to_config, make_link, parse_quirks

from acsar_gym import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.excitation import TapedLink
from acsar_gym.tools.sysid.identify import Identification, ParameterFinding, identify_device

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


class Score(NamedTuple):
    """How well a finding of a wheel or of the board agrees with the truth."""

    name: str
    is_told: bool
    error: float
    """Share of the tolerance."""
    holds: bool
    """Whether the interval holds the truth."""
    text: str


def score_findings(result: Identification, truth: RobotConfig) -> list[Score]:
    """Compare findings with a hidden robot: each wheel and the board."""
    scores = []
    for finding in result.findings:
        section, field = finding.name.split(".")
        parts = [getattr(truth, section)]
        if section == "motor":
            wheels = ["abcd".index(finding.wheel)] if finding.wheel else range(4)
            parts = [truth.motor.of_wheel(wheel) for wheel in wheels]
        scores += [_score_finding(finding, getattr(fields, field)) for fields in parts]
    return scores


def _score_finding(finding: ParameterFinding, value: float | None) -> Score:
    holds = value is finding.value and finding.told
    error = 0.0 if holds else math.inf
    if value is not None and finding.value is not None:
        scale = TOLERANCES.get(finding.name, 1.0) * (value if finding.name in RELATIVE else 1.0)
        error = abs(finding.value - value) / scale
        low = math.inf if finding.low is None else finding.low
        holds = low <= value <= (finding.high or 0.0)
    text = f"{finding.name}.{finding.wheel} {finding.low} to {finding.high}, truth {value}"
    return Score(finding.name, finding.told, error, holds, text)


def find_missed_truths(result: Identification, truth: RobotConfig) -> list[str]:
    """List the findings whose intervals don't hold the truth."""
    return [s.text for s in score_findings(result, truth) if s.is_told and not s.holds]


def identify_simulated(hidden: RobotConfig, *quirks: str) -> Identification:
    """Identify a robot with these quirks in simulated time."""
    odd = parse_quirks(quirks)
    link = make_link("planar", apply_to_config(odd, hidden), odd)
    return identify_device(link, ACSAR, 20.0)


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

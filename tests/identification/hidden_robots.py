"""Robots with hidden parameters, and how well an identification finds them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.tools.sysid.identify import Identification
from acsar_gym.tools.sysid.parameter_findings import ParameterFinding

TOLERANCES = {
    "motor.time_constant": 0.05,
    "motor.gain": 0.01,
    "motor.deadband": 0.05,
    "encoder.quantum": 0.05,
    "firmware.command_delay": 0.005,
    "firmware.command_timeout": 0.06,
}
"""Shares for lags and gains, otherwise absolute."""
RELATIVE = ("motor.time_constant", "motor.gain")


def drawn(seed: int) -> RobotConfig:
    """Draw a robot as the goal of issue 11 describes it."""
    rng = np.random.default_rng(seed)
    lag = rng.uniform(0.03, 0.3)
    lags = lag * rng.uniform(0.9, 1.1, 4) if rng.random() < 0.3 else np.full(4, lag)
    return RobotConfig.preset("acsar").with_(
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


def scores(found: Identification, truth: RobotConfig) -> Iterator[Score]:
    """Compare findings with a hidden robot."""
    for name, tolerance in TOLERANCES.items():
        errors, holds, shares = [], True, [0.0]
        for one in found.findings:
            if one.name == name:
                for value in _truths(one, truth):
                    error, held = _compared(one, value, tolerance)
                    errors.append(error)
                    holds &= held
                    shares.append(_share(one, value))
        yield Score(name, max(errors), holds, max(shares))


def _truths(one: ParameterFinding, truth: RobotConfig) -> list[float | None]:
    """The hidden values that one finding is about."""
    section, field = one.name.split(".")
    if section != "motor":
        return [getattr(getattr(truth, section), field)]
    wheels = ["abcd".index(one.wheel)] if one.wheel else range(4)
    return [getattr(truth.motor.of_wheel(wheel), field) for wheel in wheels]


def _compared(one: ParameterFinding, value: float | None, tolerance: float) -> tuple[float, bool]:
    """Error as a share of the tolerance, and whether the interval holds the truth."""
    if value is None or one.value is None:
        right = value is one.value and one.told
        return (0.0 if right else np.inf), right
    scale = tolerance * (value if one.name in RELATIVE else 1.0)
    held = one.low is not None and one.high is not None and one.low <= value <= one.high
    return abs(one.value - value) / scale, held


def _share(one: ParameterFinding, value: float | None) -> float:
    """The error as a share of half the interval."""
    if value is None or one.value is None or one.low is None or one.high is None:
        return 0.0
    return abs(one.value - value) / max(1e-9, (one.high - one.low) / 2.0)

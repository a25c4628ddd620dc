"""Findings of the motors: lag, gain, ramp and deadband, one number where wheels don't differ."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import optional
from acsar_gym.identification.estimation import SMOOTH_NAMES, Estimate
from acsar_gym.identification.finding import Finding, unknown
from acsar_gym.identification.knowable import HANGS, Knowable
from acsar_gym.identification.problem import HIGH, LOW, PER_WHEEL
from acsar_gym.protocol import MOTORS

with optional("identification", "scipy"):
    from scipy import stats

Floats = NDArray[np.float64]

Z95 = 1.96
INFLATED = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots: the
twin's answer is a mean over phases."""
LEAST = 0.002
"""Least half width of an interval of a lag or gain, as a share."""
UNLIKE = 0.01
"""Wheels differ if the probability that they don't is below this."""
NO_RAMP = 1e6
"""Acceleration of a board without a ramp [rad/s^2]; the largest of the field."""
EDGE = 0.02
"""A value so near its bound, as a share of it, has ended there."""
VAGUE = {
    "motor.time_constant": 0.3,
    "motor.gain": 0.05,
    "motor.acceleration": 0.6,
    "motor.deadband": 0.3,
}
"""Half widths of intervals above which a number isn't told: shares, but for deadbands [rad/s]."""


def of_wheels(estimate: Estimate | None, config: RobotConfig, known: Knowable) -> list[Finding]:
    """Findings of the four motors; one for all wheels where they don't differ."""
    found = []
    for p, name in enumerate(SMOOTH_NAMES):
        found += _merged(
            [_smooth(estimate, config, known, name, p, k) for k in range(4)],
            _share_spread(estimate, p),
        )
    bands = [_deadband(estimate, config, known, k) for k in range(4)]
    return found + _merged(bands, None)


def _before(config: RobotConfig, wheel: int, name: str) -> float:
    own = config.motor.of_wheel(wheel)
    return float(getattr(own, name.removeprefix("motor.")))


def _smooth(
    estimate: Estimate | None, config: RobotConfig, known: Knowable, name: str, p: int, wheel: int
) -> Finding:
    """Lag, gain or ramp of one wheel."""
    letter, before = MOTORS[wheel], _before(config, wheel, name)
    if estimate is None or not known.can(name, letter):
        return unknown(name, letter, before, known.missing[name, letter])
    index = PER_WHEEL * estimate.problem.wheels.index(wheel) + p
    value = float(estimate.solution.x[index])
    half = Z95 * INFLATED * math.sqrt(estimate.spread[index, index]) + float(estimate.slack[index])
    if name == "motor.acceleration":
        return _ramp(letter, before, value, half)
    half = max(half, LEAST * value)
    if value > HIGH[p] * (1.0 - EDGE) or value < LOW[p] * (1.0 + EDGE):
        return unknown(name, letter, before, f"the fit ended at its bound of {value:.3g}")
    if half > VAGUE[name] * value:
        return unknown(name, letter, before, f"too vague, +-{half / value:.0%}: record more steps")
    low = max(0.0, value - half)
    return Finding(name, letter, value, low, value + half, before, told=True)


def _ramp(letter: str, before: float, slowness: float, half: float) -> Finding:
    """The ramp of one wheel, from the time it needs for 1 rad/s and its half width."""
    name = "motor.acceleration"
    if slowness > HIGH[2] * (1.0 - EDGE):
        return unknown(name, letter, before, "the fit ended at its bound")
    if slowness - half <= 0.0 or slowness < 1.0 / NO_RAMP or slowness < 1e-3:
        fastest = 1.0 / max(slowness + half, 1e-6)
        note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
        return Finding(name, letter, NO_RAMP, fastest, NO_RAMP, before, note, told=True)
    if half > VAGUE[name] * slowness:
        return unknown(name, letter, before, "too vague: record more large steps")
    low, high = 1.0 / (slowness + half), min(NO_RAMP, 1.0 / (slowness - half))
    return Finding(name, letter, 1.0 / slowness, low, high, before, told=True)


def _deadband(
    estimate: Estimate | None, config: RobotConfig, known: Knowable, wheel: int
) -> Finding:
    """The deadband of one wheel."""
    name, letter = "motor.deadband", MOTORS[wheel]
    before = _before(config, wheel, name)
    if estimate is None or not known.can(name, letter):
        return unknown(name, letter, before, known.missing[name, letter])
    index = estimate.problem.wheels.index(wheel)
    one = estimate.deadbands[index]
    if one is None:
        return unknown(name, letter, before, "the wheel never turned")
    lag = _smooth(estimate, config, known, SMOOTH_NAMES[0], 0, wheel)
    if not lag.told and estimate.motors[index].lag > LOW[0] * (1.0 + EDGE):
        return unknown(name, letter, before, HANGS)
    if one.high > known.slowest[wheel]:
        most = known.slowest[wheel]
        why = f"ended at its bound: slow commands up to {most:.1f} rad/s don't show it"
        return unknown(name, letter, before, why)
    if one.high - one.low > 2.0 * VAGUE[name]:
        return unknown(name, letter, before, "too vague: command a slower staircase")
    return Finding(name, letter, one.value, one.low, one.high, before, told=True)


def _share_spread(estimate: Estimate | None, p: int) -> Floats | None:
    """Covariance of one parameter of all wheels in the problem."""
    if estimate is None:
        return None
    rows = [PER_WHEEL * k + p for k in range(len(estimate.problem.wheels))]
    return np.asarray(estimate.spread[np.ix_(rows, rows)])


def _merged(four: list[Finding], spread: Floats | None) -> list[Finding]:
    """One finding for all wheels, where all are told and they don't differ."""
    if any(one.value is None for one in four):
        reasons = {(one.note, one.value) for one in four}
        same = len(reasons) == 1
        return [_for_all(four[0])] if same else four
    values = np.array([one.value for one in four], float)
    ends = np.array([[one.low, one.high] for one in four], float)
    if (values == NO_RAMP).all():
        return [_for_all(four[0], low=float(ends[:, 0].min()), note=four[0].note)]
    sigmas = np.maximum((ends[:, 1] - ends[:, 0]) / 2.0 / Z95, 1e-9)
    weights = sigmas**-2 / (sigmas**-2).sum()
    mean = float(weights @ values)
    away = float((((values - mean) / sigmas) ** 2).sum())
    if away > stats.chi2.ppf(1.0 - UNLIKE, len(four) - 1):
        return four
    half = Z95 * float(weights @ sigmas)  # of errors that wheels have in common
    if spread is not None and len(spread) == len(four):
        shares = np.sqrt(np.maximum(np.diag(spread), 1e-18))
        common = spread / np.outer(shares, shares)
        half = Z95 * math.sqrt(float((weights * sigmas) @ common @ (weights * sigmas)))
    half *= max(1.0, math.sqrt(away / (len(four) - 1)))
    return [_for_all(four[0], value=mean, low=max(0.0, mean - half), high=mean + half)]


def _for_all(one: Finding, **changes: float | str) -> Finding:
    """The finding of one wheel, for all."""
    return replace(one, wheel="", **changes)  # type: ignore[arg-type]

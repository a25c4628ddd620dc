"""Fits with their errors, and what is told of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym.tools.sysid import parameter_findings
from acsar_gym.tools.sysid.board_log import Floats, Identifiability
from acsar_gym.tools.sysid.fit import (
    FitSolution,
    MotorFit,
    SpeedRounding,
    configured_times,
    configured_wheel,
)
from acsar_gym.tools.sysid.model_check import STEADY_FAST, PartError
from acsar_gym.tools.sysid.parameter_findings import INTERVAL_FACTOR, NO_RAMP, ParameterFinding
from acsar_gym.tools.sysid.response import PARAMETERS_PER_WHEEL, FitProblem

DT = 1.0 / ACSAR.firmware.loop_rate
GAIN, SLOWNESS, MIDDLE, WINDOW = 1, 2, -3, -2
"""Places of these among a fit's numbers, of one wheel and the board."""


def make_fit(
    place: int, value: float | Sequence[float], half: float | Sequence[float], wheels: int = 1
) -> MotorFit:
    """A fit of the first wheels, one number of which has an error."""
    problem = FitProblem((), tuple(range(wheels)), DT, ACSAR.motor.max_speed)
    models = [configured_wheel(ACSAR, wheel) for wheel in range(wheels)]
    x = problem.join(models, configured_times(ACSAR))
    spread: Floats = np.zeros((len(x), len(x)))
    places = place + PARAMETERS_PER_WHEEL * np.arange(wheels) if place >= 0 else place
    x[places] = value
    sigmas = np.asarray(half) / parameter_findings.NORMAL_QUANTILE / INTERVAL_FACTOR
    spread[places, places] = sigmas**2
    solution = FitSolution(x, (0.0,) * wheels, np.ones(len(x), bool), 0.1)
    rest = (np.zeros(len(x)), (None,) * wheels, None, SpeedRounding(0.0, 0.0))
    return MotorFit(problem, solution, spread, *rest, counted=False, bounded=False)


def find_all(fit: MotorFit, name: str) -> list[ParameterFinding]:
    """Findings of one parameter where the log tells it of four wheels."""
    unknown = Identifiability({("motor.deadband", wheel): "" for wheel in "abcd"})
    found = parameter_findings.find_wheels(fit, ACSAR, unknown)
    return [one for one in found if one.name == name]


def test_wheels_that_cannot_be_told_apart_have_one_value() -> None:
    gains = find_all(make_fit(GAIN, (0.991, 0.998, 0.85, 1.003), (0.01,) * 4, 4), "motor.gain")
    assert [one.wheel for one in gains] == ["a", "b", "c", "d"]
    a, b, c, d = gains
    assert a.value == b.value == d.value == pytest.approx(0.997, abs=1e-3)
    assert a.low is not None
    assert a.high is not None
    assert a.low < 0.991 - 0.005
    assert a.high > 1.003 + 0.005
    assert c.value == pytest.approx(0.85)


def test_what_the_model_misses_widens_the_intervals_of_gains() -> None:
    fit = make_fit(GAIN, 1.0, 0.005)
    unknown = Identifiability({("motor.deadband", wheel): "" for wheel in "abcd"})
    for name in ("motor.time_constant", "motor.gain", "motor.acceleration"):
        unknown.missing |= {(name, wheel): "" for wheel in "bcd"}
    parts = [PartError(0, STEADY_FAST, 0.13, 0.05, 6.0)]  # 0.12 rad/s beyond the noise
    found = parameter_findings.find_wheels(fit, ACSAR, unknown, parts)
    gain = next(one for one in found if (one.name, one.wheel) == ("motor.gain", "a"))
    assert gain.low == pytest.approx(0.975)
    assert gain.high == pytest.approx(1.025)


@pytest.mark.parametrize(
    ("slowness", "half", "told"),
    [
        (0.02, 0.002, 50.0),
        (0.03, 0.031, None),
        (0.0005, 0.03, None),
        (0.02, 0.015, None),
        (0.003, 0.004, NO_RAMP),
        (0.0005, 0.0002, NO_RAMP),
        (0.0, 0.0, NO_RAMP),
    ],
)
def test_no_ramp_is_told_only_where_the_log_shows_it(
    slowness: float, half: float, told: float | None
) -> None:
    unknown = Identifiability({("motor.deadband", w): "" for w in "abcd"})
    for name in ("motor.time_constant", "motor.gain", "motor.acceleration"):
        unknown.missing |= {(name, wheel): "" for wheel in "bcd"}
    found = parameter_findings.find_wheels(make_fit(SLOWNESS, slowness, half), ACSAR, unknown)
    (ramp,) = (one for one in found if (one.name, one.wheel) == ("motor.acceleration", "a"))
    assert ramp.value == pytest.approx(told)
    assert ramp.told == (told is not None)
    assert ramp.told or "too vague" in ramp.note

"""Fits with their errors, and what is told of them."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym.tools.sysid import parameter_findings
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.tools.sysid.fit import (
    DEADBAND_GRID,
    LARGEST_DEADBAND,
    FitSolution,
    MotorFit,
    SpeedRounding,
    configured_times,
    configured_wheel,
    fit_deadband,
)
from acsar_gym.tools.sysid.identifiability import Identifiability
from acsar_gym.tools.sysid.parameter_findings import INTERVAL_FACTOR, NO_RAMP, ParameterFinding
from acsar_gym.tools.sysid.response import FitProblem
from acsar_gym.tools.sysid.tracks import BoardTrack

DT = 1.0 / ACSAR.firmware.loop_rate
SLOWNESS, WINDOW = 2, -2
"""Places of these among a fit's numbers, of one wheel and the board."""


def make_fit(place: int, value: float, half: float) -> MotorFit:
    """A fit of wheel a, one number of which has an error."""
    problem = FitProblem((), (0,), DT, ACSAR.motor.max_speed)
    x = problem.join([configured_wheel(ACSAR, 0)], configured_times(ACSAR))
    spread: Floats = np.zeros((len(x), len(x)))
    x[place] = value
    spread[place, place] = (half / parameter_findings.NORMAL_QUANTILE / INTERVAL_FACTOR) ** 2
    solution = FitSolution(x, (0.0,), np.ones(len(x), bool), 0.1)
    rest = (np.zeros(len(x)), (None,), None, SpeedRounding(0.0, 0.0))
    return MotorFit(problem, solution, spread, *rest, counted=False, bounded=False)


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


@pytest.mark.parametrize(
    ("half", "told"), [(0.01, True), (0.05, True), (0.08, False), (0.15, False)]
)
def test_an_averaging_time_may_be_too_vague(half: float, told: bool) -> None:
    fit = make_fit(WINDOW, 0.06, half)
    found = parameter_findings._find_window(ParameterFinding("encoder.window"), fit)
    assert found.told == told
    assert (found.value is None) != told
    assert told or "too vague" in found.note


@pytest.mark.parametrize(("usual", "value"), [(None, LARGEST_DEADBAND / 2.0), (0.3, 0.3)])
def test_no_deadband_is_likelier_than_another_before_the_log(
    usual: float | None, value: float
) -> None:
    """Of a log at rest, which fits any: their mean, or the usual one."""
    stamps = np.arange(0.0, 10.0, 0.01)
    rest = np.zeros((len(stamps), 4))
    numbers = np.arange(len(stamps))
    track = BoardTrack(stamps, rest, stamps, rest, np.zeros(len(stamps), bool), numbers)
    problem = FitProblem.of((track,), (0,), ACSAR)
    model, times = configured_wheel(ACSAR, 0), configured_times(ACSAR)
    found = fit_deadband(problem, 0, model, times, SpeedRounding(0.0, 0.0), usual)
    assert found.value == pytest.approx(value, abs=DEADBAND_GRID / 10.0)

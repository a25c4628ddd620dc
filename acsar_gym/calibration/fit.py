"""Least squares for radii and multiplier over the readings of all runs together.

Every reading is compared with odometry integrated from that run's wheel angles, so lag, ramps and
limits of the drive don't matter, and straight lines, turns and squares share one fit. A parameter
that the readings can't tell keeps the config's value, and its uncertainty widens the intervals of
the others.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.calibration.model import Geometry, configured, differences, sigmas
from acsar_gym.calibration.runs import Floats, Run
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, optional

with optional("calibration", "scipy"):
    from scipy import optimize, stats

NAMES = ("wheel_radius", "radius_ratio", "wheel_separation_multiplier")
"""The fitted parameters: those of Geometry, in its order."""
PRIOR = np.array([0.025, 0.03, 0.5])
"""Standard deviations before anything is measured: radius and multiplier as shares of the config's,
ratio as it is."""
TOLD = 0.4
"""A parameter counts as told where the readings narrow its prior to less than this share."""
OUTLIER = 5.0
"""A run with a residual of more than this many robust standard deviations is left out."""
SYSTEMATIC = np.array([5e-4, 3e-4, 1e-3])
"""Standard deviations that more runs don't narrow: digits that the board prints, and skidding."""
KNOWN = 8.0
"""How many readings the stated precision of the readings is worth, beside the residuals."""
LOW = np.array([0.5, -0.3, 0.2])
"""Lower bounds: radius and multiplier as shares of the config's, ratio as it is."""
HIGH = np.array([2.0, 0.3, 5.0])
"""Upper bounds, likewise."""
STARTS = ((1.0,), tuple(np.linspace(-0.06, 0.06, 5)), tuple(np.geomspace(0.45, 2.6, 25)))
"""Grid from which the fit starts, likewise."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One fitted number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, half: float) -> Estimate:
        """The estimate with an interval of value - half to value + half."""
        return cls(value, value - half, value + half)


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """Result of a fit."""

    geometry: Geometry
    """Radii and multiplier; those that weren't told are the config's."""
    told: dict[str, Estimate]
    """The parameters that the readings tell, by NAMES; the ratio is right less left radius, as a
    share of their mean."""
    used: tuple[Run, ...]
    """Runs with readings that were fitted."""
    outliers: tuple[Run, ...]
    """Runs that contradict the others, which were left out."""
    rms: float
    """Root mean square of the residuals, in standard deviations."""


def fit(runs: Sequence[Run], config: RobotConfig) -> Fit:
    """Fit radii and multiplier to the readings of all runs.

    Args:
        runs: those without readings are left out.
        config: of the robot; parameters that the readings can't tell are taken from it.

    Raises:
        ConfigError: no run has a reading, the readings tell no parameter, or the best fit is at a
            bound.
    """
    used = [run for run in runs if run.readings]
    if not used:
        raise ConfigError("no run has a reading yet: measure its end, then give --measured")
    problem = _Problem(used, config)
    p = problem.solve(problem.start(), (0, 1, 2), robust=True)
    outliers = problem.outliers(p)
    if outliers:
        problem = _Problem([run for run in used if run not in outliers], config)
    told = problem.tells(p)
    if not told:
        raise ConfigError(
            "the readings tell neither radius nor multiplier: drive farther, or measure finer"
        )
    p = np.where(np.isin(range(3), told), p, problem.centre)
    p = problem.solve(p, told, robust=False)
    problem.check_bounds(p, told)
    rms = float(np.sqrt(np.mean(problem.residuals(p) ** 2)))
    estimates = problem.estimates(p, told)
    return Fit(problem.geometry(p), estimates, tuple(problem.runs), tuple(outliers), rms)


class _Problem:
    """Residuals of runs as a function of parameters p.

    Radius and multiplier are shares of the config's, the ratio is as it is.
    """

    def __init__(self, runs: Sequence[Run], config: RobotConfig) -> None:
        self.runs, self.separation = runs, config.wheel_separation
        self.nominal = configured(config)
        self.centre = np.array([1.0, self.nominal.ratio, 1.0])
        self.held = _held(config)
        told = [sigmas(run, self.nominal, self.separation) for run in runs]
        self.sigma = np.array(list(itertools.chain(*told)))

    def geometry(self, p: Floats) -> Geometry:
        """The geometry of parameters."""
        radius, ratio, multiplier = map(float, p)
        return Geometry(radius * self.nominal.radius, ratio, multiplier * self.nominal.multiplier)

    def residuals(self, p: Floats) -> Floats:
        """Readings less odometry, in standard deviations, (readings,)."""
        off: Floats = differences(self.runs, self.geometry(p), self.separation) / self.sigma
        return off

    def with_prior(self, p: Floats) -> Floats:
        """The residuals, then the parameters' distances from the prior."""
        return np.concatenate([self.residuals(p), (p - self.centre) / PRIOR])

    def start(self) -> Floats:
        """The best point of the grid under a loss that forgives outliers."""
        grid = [self.centre, *map(np.array, itertools.product(*STARTS))]
        return min(grid, key=lambda p: float(np.sqrt(1.0 + self.with_prior(p) ** 2).sum()))

    def solve(self, start: Floats, free: Sequence[int], *, robust: bool) -> Floats:
        """Minimise over the free parameters; the others stay at `start`.

        Robust: with the prior, and a loss that forgives outliers.
        """
        chosen = list(free)

        def residuals(values: Floats) -> Floats:
            p = start.copy()
            p[chosen] = values
            return self.with_prior(p) if robust else self.residuals(p)

        p = start.copy()
        p[chosen] = optimize.least_squares(
            residuals,
            start[chosen],
            bounds=(LOW[chosen], HIGH[chosen]),
            loss="soft_l1" if robust else "linear",
            f_scale=2.0,
            xtol=1e-12,
        ).x
        return p

    def jacobian(self, p: Floats) -> Floats:
        """Derivatives of the residuals, (readings, 3)."""
        step = 1e-6
        return np.stack(
            [
                (self.residuals(p + step * one) - self.residuals(p - step * one)) / (2.0 * step)
                for one in np.eye(3)
            ],
            axis=1,
        )

    def outliers(self, p: Floats) -> list[Run]:
        """The runs whose residuals stand out; none where too few others would be left."""
        off = np.abs(self.residuals(p))
        limit = OUTLIER * max(1.0, 1.4826 * float(np.median(off)))
        ends = np.cumsum([len(run.readings) for run in self.runs])
        worst = [float(part.max()) for part in np.split(off, ends[:-1])]
        found = [run for run, most in zip(self.runs, worst, strict=True) if most > limit]
        return found if 3 * len(found) <= len(self.runs) else []

    def tells(self, p: Floats) -> list[int]:
        """Indices of the parameters that the readings tell; drops the worst one by one."""
        information = self.jacobian(p)
        told = [0, 1, 2]
        while told:
            part = information[:, told]
            precision = part.T @ part + np.diag(PRIOR[told] ** -2.0)
            left = np.sqrt(np.diag(np.linalg.inv(precision))) / PRIOR[told]
            if left.max() < TOLD:
                break
            told.pop(int(left.argmax()))
        return told

    def check_bounds(self, p: Floats, told: Sequence[int]) -> None:
        """Raise ConfigError where a parameter ended at its bound."""
        for i in told:
            if not LOW[i] * (1.0 + 1e-6) + 1e-9 < p[i] < HIGH[i] * (1.0 - 1e-6) - 1e-9:
                raise ConfigError(
                    f"the readings push {NAMES[i]} to its bound, {p[i]:.3g} times the config's: "
                    "check their units, and that they belong to these runs"
                )

    def estimates(self, p: Floats, told: Sequence[int]) -> dict[str, Estimate]:
        """Values and 95 % intervals (Student t) of the parameters that are told."""
        information = self.jacobian(p)
        unknown = np.array([0.0 if i in told else self.held[i] ** -2.0 for i in range(3)])
        covariance = np.linalg.inv(information.T @ information + np.diag(unknown))
        residuals = self.residuals(p)
        freedom = KNOWN + len(residuals) - len(told)
        spread = math.sqrt((KNOWN + float(residuals @ residuals)) / freedom)
        quantile = float(stats.t.ppf(0.975, freedom)) * spread
        half = np.hypot(quantile * np.sqrt(np.diag(covariance)), 1.96 * SYSTEMATIC)
        unit = np.array([self.nominal.radius, 1.0, self.nominal.multiplier])
        return {
            NAMES[i]: Estimate.around(float(p[i] * unit[i]), float(half[i] * unit[i])) for i in told
        }


def _held(config: RobotConfig) -> Floats:
    """Standard deviations of parameters that aren't fitted: as measured before, else the prior."""
    held = PRIOR.copy()
    for i in (0, 2):
        found = config.measured.get(NAMES[i])
        if found is not None:
            held[i] = max((found.high - found.low) / (2.0 * 1.96 * getattr(config, NAMES[i])), 1e-9)
    sides = [config.measured.get(f"{side}_wheel_radius_multiplier") for side in ("left", "right")]
    widths = [found.high - found.low for found in sides if found is not None]
    if widths:
        held[1] = max(2.0 * max(widths) / (2.0 * 1.96), 1e-9)
    return held

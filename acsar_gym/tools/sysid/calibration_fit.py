"""Least squares for radii and multiplier over the readings of all runs, and what it says."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics.randomization import LEAST_TURN
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.calibration_runs import (
    CalibrationRun,
    Floats,
    Geometry,
    configured_geometry,
    hash_runs,
    predict_readings,
    reading_differences,
    reading_sigmas,
)

with require_extra("calibration", "scipy"):
    from scipy import optimize, stats

GEOMETRY_PARAMETERS = ("wheel_radius", "radius_ratio", "wheel_separation_multiplier")
"""The fitted parameters: those of Geometry, in its order."""
GEOMETRY_PRIOR = np.array([0.025, 0.03, 0.5])
"""Standard deviations before anything is measured: radius and multiplier as shares of the config's,
ratio as it is."""
TOLD_SHARE = 0.4
"""A parameter counts as told where the readings narrow its prior to less than this share."""
OUTLIER_SIGMAS = 5.0
"""A run with a residual of more than this many robust standard deviations is left out."""
SYSTEMATIC_SIGMAS = np.array([5e-4, 3e-4, 1e-3])
"""Standard deviations that more runs don't narrow: digits that the board prints, and skidding."""
KNOWN_READINGS = 8.0
"""How many readings the stated precision of the readings is worth, beside the residuals."""
GEOMETRY_LOW = np.array([0.5, -0.3, 0.2])
"""Lower bounds: radius and multiplier as shares of the config's, ratio as it is."""
GEOMETRY_HIGH = np.array([2.0, 0.3, 5.0])
"""Upper bounds, likewise."""
GEOMETRY_STARTS = ((1.0,), tuple(np.linspace(-0.06, 0.06, 5)), tuple(np.geomspace(0.45, 2.6, 25)))
"""Grid from which the fit starts, likewise."""


@dataclass(frozen=True, slots=True)
class FittedValue:
    """One fitted number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, half: float) -> FittedValue:
        """The estimate with an interval of value - half to value + half."""
        return cls(value, value - half, value + half)


@dataclass(frozen=True, eq=False, slots=True)
class GeometryFit:
    """Result of a fit."""

    geometry: Geometry
    """Radii and multiplier; those that weren't told are the config's."""
    told: dict[str, FittedValue]
    """The parameters that the readings tell, by NAMES; the ratio is right less left radius, as a
    share of their mean."""
    used: tuple[CalibrationRun, ...]
    """Runs with readings that were fitted."""
    outliers: tuple[CalibrationRun, ...]
    """Runs that contradict the others, which were left out."""
    rms: float
    """Root mean square of the residuals, in standard deviations."""


def fit_geometry(runs: Sequence[CalibrationRun], config: RobotConfig) -> GeometryFit:
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
    return GeometryFit(problem.geometry(p), estimates, tuple(problem.runs), tuple(outliers), rms)


class _Problem:
    """Residuals of runs as a function of parameters p.

    Radius and multiplier are shares of the config's, the ratio is as it is.
    """

    def __init__(self, runs: Sequence[CalibrationRun], config: RobotConfig) -> None:
        self.runs, self.separation = runs, config.wheel_separation
        self.nominal = configured_geometry(config)
        self.centre = np.array([1.0, self.nominal.ratio, 1.0])
        self.held = _held(config)
        told = [reading_sigmas(run, self.nominal, self.separation) for run in runs]
        self.sigma = np.array(list(itertools.chain(*told)))

    def geometry(self, p: Floats) -> Geometry:
        """The geometry of parameters."""
        radius, ratio, multiplier = map(float, p)
        return Geometry(radius * self.nominal.radius, ratio, multiplier * self.nominal.multiplier)

    def residuals(self, p: Floats) -> Floats:
        """Readings less odometry, in standard deviations, (readings,)."""
        off: Floats = reading_differences(self.runs, self.geometry(p), self.separation) / self.sigma
        return off

    def with_prior(self, p: Floats) -> Floats:
        """The residuals, then the parameters' distances from the prior."""
        return np.concatenate([self.residuals(p), (p - self.centre) / GEOMETRY_PRIOR])

    def start(self) -> Floats:
        """The best point of the grid under a loss that forgives outliers."""
        grid = [self.centre, *map(np.array, itertools.product(*GEOMETRY_STARTS))]
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
            bounds=(GEOMETRY_LOW[chosen], GEOMETRY_HIGH[chosen]),
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

    def outliers(self, p: Floats) -> list[CalibrationRun]:
        """The runs whose residuals stand out; none where too few others would be left."""
        off = np.abs(self.residuals(p))
        limit = OUTLIER_SIGMAS * max(1.0, 1.4826 * float(np.median(off)))
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
            precision = part.T @ part + np.diag(GEOMETRY_PRIOR[told] ** -2.0)
            left = np.sqrt(np.diag(np.linalg.inv(precision))) / GEOMETRY_PRIOR[told]
            if left.max() < TOLD_SHARE:
                break
            told.pop(int(left.argmax()))
        return told

    def check_bounds(self, p: Floats, told: Sequence[int]) -> None:
        """Raise ConfigError where a parameter ended at its bound."""
        for i in told:
            if (
                not GEOMETRY_LOW[i] * (1.0 + 1e-6) + 1e-9
                < p[i]
                < GEOMETRY_HIGH[i] * (1.0 - 1e-6) - 1e-9
            ):
                raise ConfigError(
                    f"the readings push {GEOMETRY_PARAMETERS[i]} to its bound, {p[i]:.3g} "
                    "times the config's: "
                    "check their units, and that they belong to these runs"
                )

    def estimates(self, p: Floats, told: Sequence[int]) -> dict[str, FittedValue]:
        """Values and 95 % intervals (Student t) of the parameters that are told."""
        information = self.jacobian(p)
        unknown = np.array([0.0 if i in told else self.held[i] ** -2.0 for i in range(3)])
        covariance = np.linalg.inv(information.T @ information + np.diag(unknown))
        residuals = self.residuals(p)
        freedom = KNOWN_READINGS + len(residuals) - len(told)
        spread = math.sqrt((KNOWN_READINGS + float(residuals @ residuals)) / freedom)
        quantile = float(stats.t.ppf(0.975, freedom)) * spread
        half = np.hypot(quantile * np.sqrt(np.diag(covariance)), 1.96 * SYSTEMATIC_SIGMAS)
        unit = np.array([self.nominal.radius, 1.0, self.nominal.multiplier])
        return {
            GEOMETRY_PARAMETERS[i]: FittedValue.around(
                float(p[i] * unit[i]), float(half[i] * unit[i])
            )
            for i in told
        }


def _held(config: RobotConfig) -> Floats:
    """Standard deviations of parameters that aren't fitted: as measured before, else the prior."""
    held = GEOMETRY_PRIOR.copy()
    for i in (0, 2):
        found = config.measured.get(GEOMETRY_PARAMETERS[i])
        if found is not None:
            held[i] = max(
                (found.high - found.low) / (2.0 * 1.96 * getattr(config, GEOMETRY_PARAMETERS[i])),
                1e-9,
            )
    sides = [config.measured.get(f"{side}_wheel_radius_multiplier") for side in ("left", "right")]
    widths = [found.high - found.low for found in sides if found is not None]
    if widths:
        held[1] = max(2.0 * max(widths) / (2.0 * 1.96), 1e-9)
    return held


RADIUS_FIELDS = ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
MULTIPLIER_FIELD = "wheel_separation_multiplier"
TURN_FACTOR_FIELD = "body.turn_factor"
UNITS = {"wheel_radius": "mm"}
"""Fields that are shown in millimetres; the others have no unit."""


def fitted_fields(fit: GeometryFit, config: RobotConfig) -> dict[str, FittedValue]:
    """The fitted fields of a robot's config with their intervals, by dotted name.

    `wheel_radius` becomes the mean radius of both sides and their multipliers 1 -+ half the ratio,
    where the ratio was told; else the multipliers stay as they are. `body.turn_factor` is the
    multiplier, so that the twin turns as the robot does; a tyre's is above 1.
    """
    found: dict[str, FittedValue] = {}
    sides = (config.left_wheel_radius_multiplier, config.right_wheel_radius_multiplier)
    told, mean = fit.told, sum(sides) / 2.0
    if "radius_ratio" in told:
        one, mean = told["radius_ratio"], 1.0
        half = (one.high - one.low) / 4.0
        for name, sign in zip(RADIUS_FIELDS, (-1.0, 1.0), strict=True):
            found[name] = FittedValue.around(1.0 + sign * one.value / 2.0, half)
        if fit.geometry.radius != config.wheel_radius:
            found["wheel_radius"] = FittedValue(*[fit.geometry.radius] * 3)
    if "wheel_radius" in told:
        found["wheel_radius"] = _scaled(told["wheel_radius"], 1.0 / mean)
    if MULTIPLIER_FIELD in told:
        found[MULTIPLIER_FIELD] = told[MULTIPLIER_FIELD]
        if told[MULTIPLIER_FIELD].value > 1.0:
            one = told[MULTIPLIER_FIELD]
            low = max(one.low, min(one.value, LEAST_TURN))
            found[TURN_FACTOR_FIELD] = FittedValue(one.value, low, one.high)
    return {
        name: found[name]
        for name in ("wheel_radius", *RADIUS_FIELDS, MULTIPLIER_FIELD, TURN_FACTOR_FIELD)
        if name in found
    }


def make_calibrated_config(fit: GeometryFit, config: RobotConfig) -> RobotConfig:
    """The robot's config with what was found, and `measured` entries with method and logs."""
    found = fitted_fields(fit, config)
    kinds = " ".join(sorted({run.manoeuvre for run in fit.used}))
    logs = (hash_runs(fit.used, config),)
    measured = {
        name: Measured(low=one.low, high=one.high, method=f"calibrate {kinds}", logs=logs)
        if one.high > one.low
        else None
        for name, one in found.items()
    }
    if MULTIPLIER_FIELD in found:  # one that a tyre can't have ends the tyre's interval
        measured.setdefault(TURN_FACTOR_FIELD, None)
    changes: dict[str, Any] = {name: one.value for name, one in found.items() if "." not in name}
    if TURN_FACTOR_FIELD in found:
        changes["body"] = {"turn_factor": found[TURN_FACTOR_FIELD].value}
    return config.with_(**changes, measured=update_measured(config.measured, measured))


def calibration_table(fit: GeometryFit, config: RobotConfig) -> Table:
    """The fitted fields with their intervals, beside the config's values."""
    found = Table(title="Calibrated, with 95 % intervals", title_justify="left")
    for column in ("field", "config", "found", "low", "high", ""):
        found.add_column(column, justify="left" if column in ("field", "") else "right")
    for name, one in fitted_fields(fit, config).items():
        factor, unit = (1000.0, "mm") if name == "wheel_radius" else (1.0, "")
        before = config.body.turn_factor if name == TURN_FACTOR_FIELD else getattr(config, name)
        numbers = [before, one.value] + ([one.low, one.high] if one.high > one.low else [None] * 2)
        cells = ["-" if n is None else f"{factor * n:.4f}" for n in numbers]
        found.add_row(name, *cells, unit)
    found.caption = "\n".join(calibration_captions(fit))
    return found


def calibration_captions(fit: GeometryFit) -> list[str]:
    """Lines below the table: what wasn't told, and which runs were left out."""
    lines = [f"{len(fit.used)} runs, residuals {fit.rms:.1f} times what the readings' scales allow"]
    held = [text for name, text in MISSING_HINTS.items() if name not in fit.told]
    lines += [f"Not told by these runs: {text}." for text in held]
    lines += [f"Left out, contradicts the others: {escape_text(run.name)}." for run in fit.outliers]
    return lines


MISSING_HINTS = {
    "wheel_radius": "the wheels' mean radius (calibrate straight tells it)",
    "radius_ratio": "left against right radius (calibrate square, or turn --radii 0.5 both ways)",
    MULTIPLIER_FIELD: "the multiplier (calibrate turn tells it)",
}
"""What tells a parameter that the fit couldn't."""


def runs_table(runs: Sequence[CalibrationRun], fit: GeometryFit, config: RobotConfig) -> Table:
    """Every run's readings beside odometry, before and after."""
    found = Table(title="Runs", title_justify="left")
    for column in ("run", "measured", "odometry before", "after", "off by"):
        found.add_column(column, justify="left" if column == "run" else "right")
    separation = config.wheel_separation
    for run in runs:
        before = predict_readings(run, configured_geometry(config), separation)
        after = predict_readings(run, fit.geometry, separation)
        sigma = reading_sigmas(run, fit.geometry, separation)
        name = run.name + (" (left out)" if run in fit.outliers else "")
        for i, reading in enumerate(run.readings):
            numbers = (reading.value, before[i], after[i], reading.value - after[i])
            cells = [_shown(reading.kind, number) for number in numbers]
            wide = abs(reading.value - after[i]) > 4.0 * sigma[i]
            found.add_row(
                escape_text(name) if i == 0 else "",
                f"{reading.kind} {cells[0]}",
                *cells[1:3],
                cells[3] + (" !" if wide else ""),
            )
            if wide:
                found.caption = "! off by more than 4 times what its scale allows"
    return found


def format_calibration(
    fit: GeometryFit | None, runs: Sequence[CalibrationRun], config: RobotConfig
) -> dict[str, Any]:
    """The result for JSON; without a fit, where no run has a reading, nothing is found."""
    return {
        "found": {
            name: {"value": one.value, "low": one.low, "high": one.high}
            for name, one in (fitted_fields(fit, config) if fit else {}).items()
        },
        "not_told": [name for name in MISSING_HINTS if fit is None or name not in fit.told],
        "left_out": [run.name for run in fit.outliers] if fit else [],
        "rms": fit.rms if fit else None,
        "runs": [_run_dict(run, fit, config) for run in runs],
    }


def _run_dict(run: CalibrationRun, fit: GeometryFit | None, config: RobotConfig) -> dict[str, Any]:
    """One run for JSON: readings, and odometry before and after."""
    before = predict_readings(run, configured_geometry(config), config.wheel_separation)
    after = predict_readings(run, fit.geometry, config.wheel_separation) if fit else before
    return {
        "name": run.name,
        "manoeuvre": run.manoeuvre,
        "readings": [
            {"kind": r.kind, "value": r.value, "source": r.source, "before": b, "after": a}
            for r, b, a in zip(run.readings, before, after, strict=True)
        ],
        "wheels": run.wheels[-1].tolist(),
    }


def _scaled(one: FittedValue, factor: float) -> FittedValue:
    """The estimate times a factor."""
    return FittedValue(one.value * factor, one.low * factor, one.high * factor)


def _shown(kind: str, value: float) -> str:
    """Format a reading."""
    if kind == "heading":
        return f"{math.degrees(value):.1f} deg"
    return f"{value:.3f} m"

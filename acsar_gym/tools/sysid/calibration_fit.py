"""Least squares for radii and multiplier over the readings of all runs together, and its results.

Every reading is compared with odometry integrated from that run's wheel angles, so lag, ramps and
limits of the drive don't matter, and straight lines and turns share one fit. A parameter
that the readings can't tell keeps the config's value, and its uncertainty widens the intervals of
the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics.randomization import LEAST_TURN
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.board_log import Estimate, Floats
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    configured_geometry,
    hash_runs,
    predict_readings,
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
RADIUS_FIELDS = ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
MULTIPLIER_FIELD = "wheel_separation_multiplier"
TURN_FACTOR_FIELD = "body.turn_factor"
MISSING_HINTS = {
    "wheel_radius": "the wheels' mean radius (calibrate straight tells it)",
    "radius_ratio": "left against right radius (calibrate turn --radii 0.5, or straight --aside)",
    MULTIPLIER_FIELD: "the multiplier (calibrate turn tells it)",
}
"""What tells a parameter that the fit couldn't."""


@dataclass(frozen=True, eq=False, slots=True)
class GeometryFit:
    """Result of a fit."""

    geometry: Geometry
    """Radii and multiplier; those that weren't told are the config's."""
    told: dict[str, Estimate]
    """The parameters that the readings tell, by GEOMETRY_PARAMETERS; the ratio is right less left
    radius, as a share of their mean."""
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
    problem = _GeometryProblem(used, config)
    p = problem.solve(problem.centre, [0, 1, 2], robust=True)

    off = np.abs(problem.residuals(p))
    limit = OUTLIER_SIGMAS * max(1.0, 1.4826 * float(np.median(off)))
    ends = np.cumsum([len(run.readings) for run in used])
    worst = [float(part.max()) for part in np.split(off, ends[:-1])]
    outliers = [run for run, most in zip(used, worst, strict=True) if most > limit]
    if 3 * len(outliers) > len(used):
        outliers = []  # too few others would be left
    if outliers:
        problem = _GeometryProblem([run for run in used if run not in outliers], config)

    told = problem.find_told(p)
    if not told:
        raise ConfigError(
            "the readings tell neither radius nor multiplier: drive farther, or measure finer"
        )
    p = problem.solve(np.where(np.isin(range(3), told), p, problem.centre), told, robust=False)
    for i in told:
        low, high = GEOMETRY_LOW[i] * (1.0 + 1e-6) + 1e-9, GEOMETRY_HIGH[i] * (1.0 - 1e-6) - 1e-9
        if not low < p[i] < high:
            raise ConfigError(
                f"the readings push {GEOMETRY_PARAMETERS[i]} to its bound, {p[i]:.3g} times the "
                "config's: check their units, and that they belong to these runs"
            )
    return GeometryFit(
        problem.geometry(p),
        problem.find_intervals(p, told, config),
        tuple(problem.runs),
        tuple(outliers),
        float(np.sqrt(np.mean(problem.residuals(p) ** 2))),
    )


class _GeometryProblem:
    """Residuals of runs as a function of parameters p.

    Radius and multiplier are shares of the config's, the ratio is as it is.
    """

    def __init__(self, runs: Sequence[CalibrationRun], config: RobotConfig) -> None:
        self.runs, self.separation = runs, config.wheel_separation
        self.nominal = configured_geometry(config)
        self.centre = np.array([1.0, self.nominal.ratio, 1.0])
        sigmas = [reading_sigmas(run, self.nominal, self.separation) for run in runs]
        self.sigma = np.concatenate(sigmas)
        self.measured = np.array([reading.value for run in runs for reading in run.readings])

    def geometry(self, p: Floats) -> Geometry:
        """The geometry of parameters."""
        radius, ratio, multiplier = map(float, p)
        return Geometry(radius * self.nominal.radius, ratio, multiplier * self.nominal.multiplier)

    def residuals(self, p: Floats) -> Floats:
        """Readings less odometry, in standard deviations, (readings,)."""
        geometry = self.geometry(p)
        told = [predict_readings(run, geometry, self.separation) for run in self.runs]
        return (self.measured - np.concatenate(told)) / self.sigma

    def solve(self, start: Floats, free: list[int], *, robust: bool) -> Floats:
        """Minimise over the free parameters; the others stay at `start`.

        Robust: with the prior, and a loss that forgives outliers.
        """

        def residuals(values: Floats) -> Floats:
            p = start.copy()
            p[free] = values
            prior = (p - self.centre) / GEOMETRY_PRIOR
            return np.append(self.residuals(p), prior) if robust else self.residuals(p)

        p = start.copy()
        p[free] = optimize.least_squares(
            residuals,
            start[free],
            bounds=(GEOMETRY_LOW[free], GEOMETRY_HIGH[free]),
            loss="soft_l1" if robust else "linear",
            f_scale=2.0,
            xtol=1e-12,
        ).x
        return p

    def jacobian(self, p: Floats) -> Floats:
        """Derivatives of the residuals, (readings, 3)."""
        step = 1e-6
        columns = [
            (self.residuals(p + step * one) - self.residuals(p - step * one)) / (2.0 * step)
            for one in np.eye(3)
        ]
        return np.stack(columns, axis=1)

    def find_told(self, p: Floats) -> list[int]:
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

    def find_intervals(
        self, p: Floats, told: Sequence[int], config: RobotConfig
    ) -> dict[str, Estimate]:
        """Values and 95 % intervals (Student t) of the parameters that are told."""
        held = GEOMETRY_PRIOR.copy()  # of those that aren't: as measured before, else the prior
        for i in (0, 2):
            name = GEOMETRY_PARAMETERS[i]
            if (known := config.measured.get(name)) is not None:
                half = (known.high - known.low) / (2.0 * 1.96 * getattr(config, name))
                held[i] = max(half, 1e-9)
        sides = [one for name in RADIUS_FIELDS if (one := config.measured.get(name)) is not None]
        if sides:
            held[1] = max(2.0 * max(one.high - one.low for one in sides) / (2.0 * 1.96), 1e-9)
        information = self.jacobian(p)
        unknown = np.array([0.0 if i in told else held[i] ** -2.0 for i in range(3)])
        covariance = np.linalg.inv(information.T @ information + np.diag(unknown))
        residuals = self.residuals(p)
        freedom = KNOWN_READINGS + len(residuals) - len(told)
        spread = math.sqrt((KNOWN_READINGS + float(residuals @ residuals)) / freedom)
        quantile = float(stats.t.ppf(0.975, freedom)) * spread
        half = np.hypot(quantile * np.sqrt(np.diag(covariance)), 1.96 * SYSTEMATIC_SIGMAS)
        unit = np.array([self.nominal.radius, 1.0, self.nominal.multiplier])
        return {
            GEOMETRY_PARAMETERS[i]: Estimate.around(float(p[i] * unit[i]), float(half[i] * unit[i]))
            for i in told
        }


def fitted_fields(fit: GeometryFit, config: RobotConfig) -> dict[str, Estimate]:
    """The fitted fields of a robot's config with their intervals, by dotted name.

    `wheel_radius` becomes the mean radius of both sides and their multipliers 1 -+ half the ratio,
    where the ratio was told; else the multipliers stay as they are. `body.turn_factor` is the
    multiplier, so that the twin turns as the robot does; a tyre's is above 1.
    """
    fields: dict[str, Estimate] = {}
    mean = (config.left_wheel_radius_multiplier + config.right_wheel_radius_multiplier) / 2.0
    ratio = fit.told.get("radius_ratio")
    if ratio is not None:
        mean = 1.0
    if (radius := fit.told.get("wheel_radius")) is not None:
        fields["wheel_radius"] = Estimate(*(number / mean for number in radius))
    elif ratio is not None and fit.geometry.radius != config.wheel_radius:
        fields["wheel_radius"] = Estimate(*[fit.geometry.radius] * 3)
    if ratio is not None:
        half = (ratio.high - ratio.low) / 4.0
        for name, sign in zip(RADIUS_FIELDS, (-1.0, 1.0), strict=True):
            fields[name] = Estimate.around(1.0 + sign * ratio.value / 2.0, half)
    if (multiplier := fit.told.get(MULTIPLIER_FIELD)) is not None:
        fields[MULTIPLIER_FIELD] = multiplier
        if multiplier.value > 1.0:
            low = max(multiplier.low, min(multiplier.value, LEAST_TURN))
            fields[TURN_FACTOR_FIELD] = multiplier._replace(low=low)
    return fields


def make_calibrated_config(
    fit: GeometryFit, config: RobotConfig, *, in_ros: bool = False
) -> RobotConfig:
    """The robot's config with what was found, and `measured` entries with method and logs.

    A robot in ROS continues to take twists by the geometry of its controller.
    """
    fields = fitted_fields(fit, config)
    method = "calibrate " + " ".join(sorted({run.manoeuvre for run in fit.used}))
    logs = (hash_runs(fit.used),)
    measured = {
        name: Measured(low=fitted.low, high=fitted.high, method=method, logs=logs)
        if fitted.high > fitted.low
        else None
        for name, fitted in fields.items()
    }
    if MULTIPLIER_FIELD in fields:  # one that a tyre can't have ends the tyre's interval
        measured.setdefault(TURN_FACTOR_FIELD, None)
    changes: dict[str, Any] = {name: fitted.value for name, fitted in fields.items()}
    if (turning := changes.pop(TURN_FACTOR_FIELD, None)) is not None:
        changes["body"] = {"turn_factor": turning}
    if in_ros:
        left_radius, right_radius, separation = config.twist_geometry
        error = 1.0
        if "wheel_radius" in fields and config.ros2.command != "wheel_speeds":
            error = fmean(config.motor.of_wheel(wheel).gain for wheel in range(4))
            changes["motor"], intervals = _divide_gains(config, error)
            measured |= intervals
        changes["ros2"] = {
            "wheel_radii": (left_radius / error, right_radius / error),
            "wheel_separation": separation,
        }
    return config.with_(**changes, measured=update_measured(config.measured, measured))


def _divide_gains(config: RobotConfig, error: float) -> tuple[dict[str, Any], dict[str, Measured]]:
    """Take the error of the radii by which twists were sent out of the motors' gains.

    A controller regulates the speeds of its wheels. If they turn slower or faster than commanded,
    twists were sent by radii other than its own, and `identify` found their ratio as the gain.

    Returns:
        The gains as a change of the config's section `motor`, and their intervals.
    """
    gain = config.motor.gain
    divided = tuple(each / error for each in gain) if isinstance(gain, tuple) else gain / error
    intervals = {
        name: interval.model_copy(
            update={"low": interval.low / error, "high": interval.high / error}
        )
        for name, interval in config.measured.items()
        if name.startswith("motor.gain")
    }
    return {"gain": divided}, intervals


def calibration_table(fit: GeometryFit, config: RobotConfig) -> Table:
    """The fitted fields with their intervals, beside the config's values."""
    drawn = Table(title="Calibrated, with 95 % intervals", title_justify="left")
    for column in ("field", "config", "found", "low", "high", ""):
        drawn.add_column(column, justify="left" if column in ("field", "") else "right")
    for name, fitted in fitted_fields(fit, config).items():
        factor, unit = (1000.0, "mm") if name == "wheel_radius" else (1.0, "")
        turning = name == TURN_FACTOR_FIELD
        before = config.body.turn_factor if turning else getattr(config, name)
        interval = [fitted.low, fitted.high] if fitted.high > fitted.low else [None, None]
        numbers = [before, fitted.value, *interval]
        drawn.add_row(name, *("-" if n is None else f"{factor * n:.4f}" for n in numbers), unit)
    lines = [f"{len(fit.used)} runs, residuals {fit.rms:.1f} times what the readings' scales allow"]
    for name, text in MISSING_HINTS.items():
        if name not in fit.told:
            lines.append(f"Not told by these runs: {text}.")
    lines += [f"Left out, contradicts the others: {escape_text(run.name)}." for run in fit.outliers]
    drawn.caption = "\n".join(lines)
    return drawn


def runs_table(runs: Sequence[CalibrationRun], fit: GeometryFit, config: RobotConfig) -> Table:
    """Every run's readings beside odometry, before and after."""
    drawn = Table(title="Runs", title_justify="left")
    for column in ("run", "measured", "odometry before", "after", "off by"):
        drawn.add_column(column, justify="left" if column == "run" else "right")
    separation = config.wheel_separation
    for run in runs:
        before = predict_readings(run, configured_geometry(config), separation)
        after = predict_readings(run, fit.geometry, separation)
        sigmas = reading_sigmas(run, fit.geometry, separation)
        name = run.name + (" (left out)" if run in fit.outliers else "")
        for i, reading in enumerate(run.readings):
            off = reading.value - after[i]
            cells = [
                f"{math.degrees(value):.1f} deg" if reading.kind == "heading" else f"{value:.3f} m"
                for value in (reading.value, before[i], after[i], off)
            ]
            if wide := abs(off) > 4.0 * sigmas[i]:
                drawn.caption = "! off by more than 4 times what its scale allows"
            shown = f"{reading.kind} {cells[0]}", *cells[1:3], cells[3] + (" !" if wide else "")
            drawn.add_row(escape_text(name) if i == 0 else "", *shown)
    return drawn


def format_calibration(
    fit: GeometryFit | None, runs: Sequence[CalibrationRun], config: RobotConfig
) -> dict[str, Any]:
    """The result for JSON; without a fit, where no run has a reading, nothing is found."""
    fields = fitted_fields(fit, config) if fit else {}
    return {
        "found": {name: fitted._asdict() for name, fitted in fields.items()},
        "not_told": [name for name in MISSING_HINTS if fit is None or name not in fit.told],
        "left_out": [run.name for run in fit.outliers] if fit else [],
        "rms": fit.rms if fit else None,
        "runs": [
            {
                "name": run.name,
                "manoeuvre": run.manoeuvre,
                "readings": [reading._asdict() for reading in run.readings],
                "wheels": run.wheels[-1].tolist(),
            }
            for run in runs
        ],
    }

"""Least squares for radii and multiplier over the readings of all runs together, and its results.

Every reading is compared with odometry integrated from that run's wheel angles, so lag, ramps and
limits of the drive don't matter, and straight lines and turns share one fit. A parameter that the
readings don't narrow keeps the config's value, and its uncertainty widens the other intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from rich.table import Column, Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics.randomization import LEAST_TURN
from acsar_gym.recording.types import Floats
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.board_log import Estimate
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    check_readings,
    hash_runs,
    predict_readings,
)

with require_extra("calibration", "scipy"):
    from scipy import optimize


class Parameter(NamedTuple):
    """A fitted parameter. Radius and multiplier are fitted as shares of the config's."""

    prior: float
    """Standard deviation before anything is measured."""
    systematic: float
    """Standard deviation that more runs don't narrow: printed digits, and skidding."""
    unmodelled: float
    """Further such standard deviation for each unit by which residuals exceed their scales.

    Wheels of one side that turn unequally drag each other, and all runs agree on a wrong radius.
    Measured on simulated robots whose wheels differ by up to 10 %.
    """
    manoeuvre: str
    """What narrows it."""


PARAMETERS = {
    "wheel_radius": Parameter(0.025, 5e-4, 2.5e-3, "calibrate straight"),
    "radius_ratio": Parameter(
        0.03, 3e-4, 3e-3, "calibrate turn --radii 0.5, or straight with --aside"
    ),
    "wheel_separation_multiplier": Parameter(0.5, 1e-3, 2.5e-3, "calibrate turn"),
}
"""The parameters in the order of Geometry. The ratio is right less left radius, as a share of their
mean."""
PRIOR = np.array([parameter.prior for parameter in PARAMETERS.values()])
HELD = 1e-6
"""Prior that holds a parameter at the config's value."""
FREE = 1e3
"""Prior that leaves a parameter to the readings."""
NARROWED_SHARE = 0.4
"""A parameter is found if the readings narrow its prior to less than this share."""
OUTLIER_SIGMAS = 2.0
"""Residuals above this count less and less [standard deviations]."""
NORMAL_QUANTILE = 1.96
"""Half width of a 95 % interval in standard deviations."""
RADIUS_FIELDS = ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
MULTIPLIER_FIELD = "wheel_separation_multiplier"
TURN_FACTOR_FIELD = "body.turn_factor"


class GeometryFit(NamedTuple):
    """Result of a fit."""

    geometry: Geometry
    """Radii and multiplier. Those that weren't narrowed are the config's."""
    narrowed: dict[str, Estimate]
    """The parameters that the readings narrow, by their names in PARAMETERS."""
    runs: tuple[CalibrationRun, ...]
    """Runs with readings."""
    rms: float
    """Root mean square of the residuals in standard deviations, for each degree of freedom."""


def fit_geometry(runs: Sequence[CalibrationRun], config: RobotConfig) -> GeometryFit:
    """Fit radii and multiplier to the readings of all runs.

    Args:
        runs: Runs. Those without readings are left out.
        config: Robot configuration. Parameters that the readings don't narrow are taken from it.

    Raises:
        ConfigError: No run has a reading, a reading contradicts the odometry, or the readings
            narrow no parameter.
    """
    used = tuple(run for run in runs if run.readings)
    if not used:
        raise ConfigError("no run has a reading yet: measure its end, then give --measured")
    for run in used:
        check_readings(run, config)

    # Radius and multiplier are fitted as shares of the config's.
    nominal = Geometry.of(config)
    separation = config.wheel_separation
    centre = np.array([1.0, nominal.ratio, 1.0])
    units = np.array([nominal.radius, 1.0, nominal.multiplier])
    measured = np.array([reading.value for run in used for reading in run.readings])
    sigmas = np.concatenate([predict_readings(run, nominal, separation)[1] for run in used])

    def residuals(x: Floats) -> Floats:
        geometry = Geometry(*(x * units).tolist())
        predicted = [predict_readings(run, geometry, separation)[0] for run in used]
        return np.asarray((measured - np.concatenate(predicted)) / sigmas)

    def solve(prior: Floats) -> tuple[Floats, Floats]:
        """Return the solution, and the precision that the readings alone give it."""

        def weighted(x: Floats) -> Floats:
            return np.append(residuals(x), (x - centre) / prior)

        solution: Any = optimize.least_squares(
            weighted,
            centre,
            x_scale=PRIOR,
            loss="soft_l1",
            f_scale=OUTLIER_SIGMAS,
            xtol=1e-12,
        )
        jacobian = solution.jac[: len(measured)]
        return solution.x, jacobian.T @ jacobian

    # Parameters that the readings don't narrow are held. The others are left to the readings.
    is_narrowed = _find_spread(solve(PRIOR)[1], PRIOR) < NARROWED_SHARE * PRIOR
    if not is_narrowed.any():
        raise ConfigError(
            "the readings tell neither radius nor multiplier: drive farther, or measure finer"
        )
    solution, precision = solve(np.where(is_narrowed, FREE, HELD))
    x = np.where(is_narrowed, solution, centre)
    off = residuals(x)
    freedom = max(1, len(off) - int(is_narrowed.sum()))
    rms = math.sqrt(float(off @ off) / freedom)

    # If residuals exceed their scales, something else moves the robot, in all runs perhaps alike.
    spread = _find_spread(precision, np.where(is_narrowed, PRIOR, _known_spread(config)))
    excess = max(0.0, rms - 1.0)
    narrowed = {}
    for index, (name, parameter) in enumerate(PARAMETERS.items()):
        if is_narrowed[index]:
            systematic = parameter.systematic + parameter.unmodelled * excess
            half = NORMAL_QUANTILE * math.hypot((1.0 + excess) * spread[index], systematic)
            narrowed[name] = Estimate.around(*(np.array([x[index], half]) * units[index]).tolist())
    return GeometryFit(Geometry(*(x * units).tolist()), narrowed, used, rms)


def _find_spread(precision: Floats, prior: Floats) -> Floats:
    """Return the standard deviation of each parameter, by the readings and the prior."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(precision + np.diag(prior**-2.0)))))


def _known_spread(config: RobotConfig) -> Floats:
    """Return the standard deviation of each parameter as measured earlier, else its prior."""
    spread = PRIOR.copy()
    for name, interval in config.measured.items():
        sigma = max((interval.high - interval.low) / (2.0 * NORMAL_QUANTILE), 1e-9)
        if name in RADIUS_FIELDS:
            spread[1] = 2.0 * sigma
        elif name in PARAMETERS:
            spread[list(PARAMETERS).index(name)] = sigma / getattr(config, name)
    return spread


def fitted_fields(fit: GeometryFit, config: RobotConfig) -> dict[str, Estimate]:
    """Return the fitted fields of a robot's config with their intervals, by dotted name.

    The mean of both sides' multipliers stays as it is. `body.turn_factor` is the separation's
    multiplier, so that the twin turns as the robot does. That of a tyre is above 1.
    """
    fields: dict[str, Estimate] = {}
    # Readings show the product of radius and multipliers, so that the multipliers' mean stays.
    mean = (config.left_wheel_radius_multiplier + config.right_wheel_radius_multiplier) / 2.0

    for name, interval in fit.narrowed.items():
        # The fitted radius is the mean of both sides. The field is without the sides' multipliers.
        if name == "wheel_radius":
            fields[name] = Estimate(*(number / mean for number in interval))
        elif name == "radius_ratio":
            half = mean * (interval.high - interval.low) / 4.0
            for field, side in zip(RADIUS_FIELDS, (-0.5, 0.5), strict=True):
                fields[field] = Estimate.around(mean * (1.0 + side * interval.value), half)
        else:
            fields[name] = interval
            if interval.value > 1.0:
                low = max(interval.low, min(interval.value, LEAST_TURN))
                fields[TURN_FACTOR_FIELD] = interval._replace(low=low)
    return fields


def make_calibrated_config(
    fit: GeometryFit, config: RobotConfig, *, in_ros: bool = False
) -> RobotConfig:
    """Return the robot's config with the fitted fields, their intervals, method and logs.

    A robot in ROS continues to take twists by the geometry of its controller. Such a controller
    regulates the speeds of its wheels. If they turn slower or faster than commanded, twists were
    sent by radii other than its own, and `identify` found their ratio as the gain: a calibrated
    radius takes this error out of the gains.
    """
    fields = fitted_fields(fit, config)

    # `Randomization.measured` draws from these intervals.
    method = "calibrate " + " ".join(sorted({run.manoeuvre for run in fit.runs}))
    logs = (hash_runs(fit.runs),)
    measured: dict[str, Measured | None] = {
        name: Measured(low=interval.low, high=interval.high, method=method, logs=logs)
        for name, interval in fields.items()
    }
    changes: dict[str, Any] = {name: interval.value for name, interval in fields.items()}
    if TURN_FACTOR_FIELD in changes:
        changes["body"] = {"turn_factor": changes.pop(TURN_FACTOR_FIELD)}
    elif MULTIPLIER_FIELD in fields:  # a multiplier that no tyre has ends the tyre's interval
        measured[TURN_FACTOR_FIELD] = None

    # The controller converts twists by its own numbers, which the file keeps.
    if in_ros:
        error = 1.0
        if "wheel_radius" in fields and config.ros2.command != "wheel_speeds":
            gain = np.asarray(config.motor.gain)  # of all wheels, or of each
            error = fmean(gain.ravel())
            changes["motor"] = {"gain": (gain / error).tolist()}
            for name, interval in config.measured.items():
                if name.startswith("motor.gain"):
                    limits = {"low": interval.low / error, "high": interval.high / error}
                    measured[name] = interval.model_copy(update=limits)
        left_radius, right_radius, separation = config.twist_geometry
        radii = (left_radius / error, right_radius / error)
        changes["ros2"] = {"wheel_radii": radii, "wheel_separation": separation}
    return config.with_(**changes, measured=update_measured(config.measured, measured))


def _make_table(title: str, name: str, numbers: Sequence[str]) -> Table:
    """Return a table whose columns are numbers, but for the first."""
    columns = (Column(number, justify="right") for number in numbers)
    return Table(name, *columns, title=title, title_justify="left")


def calibration_table(fit: GeometryFit, config: RobotConfig) -> Table:
    """Return the fitted fields with their intervals, next to the config's values."""
    title = "Calibrated, with 95 % intervals"
    table = _make_table(title, "field", ("config", "found", "low", "high"))

    for name, interval in fitted_fields(fit, config).items():
        # The turn factor is a field of the body, which a robot's file may lack.
        configured = attrgetter(name)(config)
        numbers = ("-" if number is None else f"{number:.5f}" for number in (configured, *interval))
        table.add_row(f"{name} [m]" if name == "wheel_radius" else name, *numbers)

    # Residuals above 1 mean that the readings disagree by more than a tape explains.
    lines = [f"{len(fit.runs)} runs, residuals {fit.rms:.1f} times what the readings' scales allow"]
    if fit.rms > 1.0:
        lines.append("Something else moves this robot, so the intervals are wider by as much.")
    lines += [
        f"Not narrowed by these runs: {name}: {parameter.manoeuvre}."
        for name, parameter in PARAMETERS.items()
        if name not in fit.narrowed
    ]
    table.caption = "\n".join(lines)
    return table


def runs_table(fit: GeometryFit, config: RobotConfig) -> Table:
    """Return every run's readings next to odometry, with the config's and the fitted geometry."""
    table = _make_table("Runs", "run", ("measured", "odometry before", "after", "off by"))
    for run in fit.runs:
        name = escape_text(run.name)
        predictions = (
            predict_readings(run, geometry, config.wheel_separation)[0]
            for geometry in (Geometry.of(config), fit.geometry)
        )
        for reading, configured, fitted in zip(run.readings, *predictions, strict=True):
            numbers = (reading.value, configured, fitted, reading.value - fitted)
            measured, *odometry = map(reading.format, numbers)
            table.add_row(name, f"{reading.kind} {measured}", *odometry)
            name = ""  # further readings of the run
    return table


def format_calibration(
    fit: GeometryFit | None, runs: Sequence[CalibrationRun], config: RobotConfig
) -> dict[str, Any]:
    """Return the result for JSON. Without a fit, if no run has a reading, nothing is found."""
    # Runs without readings are listed as well, to be measured later.
    fields = fitted_fields(fit, config) if fit else {}

    return {
        "found": {name: interval._asdict() for name, interval in fields.items()},
        "not_told": [name for name in PARAMETERS if fit is None or name not in fit.narrowed],
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

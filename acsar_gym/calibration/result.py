"""What a fit says: a table, numbers for JSON, and the robot's config with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rich.table import Table

from acsar_gym.calibration.fit import Estimate, Fit
from acsar_gym.calibration.model import configured, predicted, sigmas
from acsar_gym.calibration.runs import Run, sha256
from acsar_gym.config import Measured, RobotConfig, renewed
from acsar_gym.dynamics.measured import LEAST_TURN
from acsar_gym.evaluation.report import plain

RADII = ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
MULTIPLIER = "wheel_separation_multiplier"
TURN_FACTOR = "body.turn_factor"
UNITS = {"wheel_radius": "mm"}
"""Fields that are shown in millimetres; the others have no unit."""


def estimates(fit: Fit, config: RobotConfig) -> dict[str, Estimate]:
    """The fitted fields of a robot's config with their intervals, by dotted name.

    `wheel_radius` becomes the mean radius of both sides and their multipliers 1 -+ half the ratio,
    where the ratio was told; else the multipliers stay as they are. `body.turn_factor` is the
    multiplier, so that the twin turns as the robot does; a tyre's is above 1.
    """
    found: dict[str, Estimate] = {}
    sides = (config.left_wheel_radius_multiplier, config.right_wheel_radius_multiplier)
    told, mean = fit.told, sum(sides) / 2.0
    if "radius_ratio" in told:
        one, mean = told["radius_ratio"], 1.0
        half = (one.high - one.low) / 4.0
        for name, sign in zip(RADII, (-1.0, 1.0), strict=True):
            found[name] = Estimate.around(1.0 + sign * one.value / 2.0, half)
        if fit.geometry.radius != config.wheel_radius:
            found["wheel_radius"] = Estimate(*[fit.geometry.radius] * 3)
    if "wheel_radius" in told:
        found["wheel_radius"] = _scaled(told["wheel_radius"], 1.0 / mean)
    if MULTIPLIER in told:
        found[MULTIPLIER] = told[MULTIPLIER]
        if told[MULTIPLIER].value > 1.0:
            one = told[MULTIPLIER]
            low = max(one.low, min(one.value, LEAST_TURN))
            found[TURN_FACTOR] = Estimate(one.value, low, one.high)
    return {
        name: found[name]
        for name in ("wheel_radius", *RADII, MULTIPLIER, TURN_FACTOR)
        if name in found
    }


def calibrated(fit: Fit, config: RobotConfig) -> RobotConfig:
    """The robot's config with what was found, and `measured` entries with method and logs."""
    found = estimates(fit, config)
    kinds = " ".join(sorted({run.manoeuvre for run in fit.used}))
    logs = (sha256(fit.used, config),)
    measured = {
        name: Measured(low=one.low, high=one.high, method=f"calibrate {kinds}", logs=logs)
        if one.high > one.low
        else None
        for name, one in found.items()
    }
    if MULTIPLIER in found:  # one that a tyre can't have ends the tyre's interval
        measured.setdefault(TURN_FACTOR, None)
    changes: dict[str, Any] = {name: one.value for name, one in found.items() if "." not in name}
    if TURN_FACTOR in found:
        changes["body"] = {"turn_factor": found[TURN_FACTOR].value}
    return config.with_(**changes, measured=renewed(config.measured, measured))


def table(fit: Fit, config: RobotConfig) -> Table:
    """The fitted fields with their intervals, beside the config's values."""
    found = Table(title="Calibrated, with 95 % intervals", title_justify="left")
    for column in ("field", "config", "found", "low", "high", ""):
        found.add_column(column, justify="left" if column in ("field", "") else "right")
    for name, one in estimates(fit, config).items():
        factor, unit = (1000.0, "mm") if name == "wheel_radius" else (1.0, "")
        before = config.body.turn_factor if name == TURN_FACTOR else getattr(config, name)
        numbers = [before, one.value] + ([one.low, one.high] if one.high > one.low else [None] * 2)
        cells = ["-" if n is None else f"{factor * n:.4f}" for n in numbers]
        found.add_row(name, *cells, unit)
    found.caption = "\n".join(captions(fit))
    return found


def captions(fit: Fit) -> list[str]:
    """Lines below the table: what wasn't told, and which runs were left out."""
    lines = [f"{len(fit.used)} runs, residuals {fit.rms:.1f} times what the readings' scales allow"]
    held = [text for name, text in MISSING.items() if name not in fit.told]
    lines += [f"Not told by these runs: {text}." for text in held]
    lines += [f"Left out, contradicts the others: {plain(run.name)}." for run in fit.outliers]
    return lines


MISSING = {
    "wheel_radius": "the wheels' mean radius (calibrate straight tells it)",
    "radius_ratio": "left against right radius (calibrate square, or turn --radii 0.5 both ways)",
    MULTIPLIER: "the multiplier (calibrate turn tells it)",
}
"""What tells a parameter that the fit couldn't."""


def runs_table(runs: Sequence[Run], fit: Fit, config: RobotConfig) -> Table:
    """Every run's readings beside odometry, before and after."""
    found = Table(title="Runs", title_justify="left")
    for column in ("run", "measured", "odometry before", "after", "off by"):
        found.add_column(column, justify="left" if column == "run" else "right")
    separation = config.wheel_separation
    for run in runs:
        before = predicted(run, configured(config), separation)
        after = predicted(run, fit.geometry, separation)
        sigma = sigmas(run, fit.geometry, separation)
        name = run.name + (" (left out)" if run in fit.outliers else "")
        for i, reading in enumerate(run.readings):
            numbers = (reading.value, before[i], after[i], reading.value - after[i])
            cells = [_shown(reading.kind, number) for number in numbers]
            wide = abs(reading.value - after[i]) > 4.0 * sigma[i]
            found.add_row(
                plain(name) if i == 0 else "",
                f"{reading.kind} {cells[0]}",
                *cells[1:3],
                cells[3] + (" !" if wide else ""),
            )
            if wide:
                found.caption = "! off by more than 4 times what its scale allows"
    return found


def as_dict(fit: Fit | None, runs: Sequence[Run], config: RobotConfig) -> dict[str, Any]:
    """The result for JSON; without a fit, where no run has a reading, nothing is found."""
    return {
        "found": {
            name: {"value": one.value, "low": one.low, "high": one.high}
            for name, one in (estimates(fit, config) if fit else {}).items()
        },
        "not_told": [name for name in MISSING if fit is None or name not in fit.told],
        "left_out": [run.name for run in fit.outliers] if fit else [],
        "rms": fit.rms if fit else None,
        "runs": [_run_dict(run, fit, config) for run in runs],
    }


def _run_dict(run: Run, fit: Fit | None, config: RobotConfig) -> dict[str, Any]:
    """One run for JSON: readings, and odometry before and after."""
    before = predicted(run, configured(config), config.wheel_separation)
    after = predicted(run, fit.geometry, config.wheel_separation) if fit else before
    return {
        "name": run.name,
        "manoeuvre": run.manoeuvre,
        "readings": [
            {"kind": r.kind, "value": r.value, "source": r.source, "before": b, "after": a}
            for r, b, a in zip(run.readings, before, after, strict=True)
        ],
        "wheels": run.wheels[-1].tolist(),
    }


def _scaled(one: Estimate, factor: float) -> Estimate:
    """The estimate times a factor."""
    return Estimate(one.value * factor, one.low * factor, one.high * factor)


def _shown(kind: str, value: float) -> str:
    """Format a reading."""
    if kind == "heading":
        return f"{math.degrees(value):.1f} deg"
    return f"{value:.3f} m"

"""How far two tracks of the same commands are from each other, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.evaluation.metrics import Interval, bootstrap
from acsar_gym.gap.delays import Floats
from acsar_gym.gap.tracks import Track
from acsar_gym.recording.jitter import steady

SHIFTS = np.arange(-0.2, 0.2001, 0.001)
"""Time shifts that are tried [s]."""
MOVING = 0.2
"""Wheels that never differ by more than this from their mean don't tell a time shift [rad/s]."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of the gap: what it is called, and how it is shown."""

    label: str
    unit: str
    scale: float
    """Factor from SI to the unit."""
    resolution: float
    """Smaller values are nothing that a log shows, in SI units."""
    rms: bool = False
    """Whether it is a root mean square, and pooled as one; otherwise a mean of sizes."""


METRICS = {
    "wheel_speed_rms": Metric("wheel speeds, RMS", "rad/s", 1.0, 1e-3, rms=True),
    "linear_rms": Metric("linear velocity, RMS", "m/s", 1.0, 1e-4, rms=True),
    "angular_rms": Metric("angular velocity, RMS", "rad/s", 1.0, 1e-3, rms=True),
    "yaw_rms": Metric("yaw, RMS", "deg", 180.0 / math.pi, 1e-3, rms=True),
    "end_pose": Metric("position at the end", "cm", 100.0, 1e-3),
    "end_yaw": Metric("yaw at the end", "deg", 180.0 / math.pi, 1e-3),
    "end_odometry": Metric("position at the end, odometry of both", "cm", 100.0, 1e-3),
    "time_shift": Metric("time shift of the wheel speeds", "ms", 1000.0, 1e-3),
}
"""The figures by name, in SI units; `--fail-over` takes these names."""

Figures = dict[str, float]
"""Values of METRICS in SI units; NaN for what a log can't tell."""


def figures(recorded: Track, twin: Track, period: float) -> Figures:
    """Compute the gap between a recorded track and a twin's that got the same commands.

    Args:
        recorded: the recorded track.
        twin: the twin's, on the same clock.
        period: nominal period of the recorded feedback [s].

    Returns:
        A value for every metric, in SI units. `time_shift` is positive where the recorded robot
        is later than the twin; the others are sizes.
    """
    wheels = residuals(recorded, twin, period)
    stamps, own = steady(recorded.feedback_stamps, period), steady(twin.feedback_stamps, period)
    twists = recorded.twists - _between(stamps, own, twin.twists)
    yaw = recorded.poses[:, 2] - twin.poses[:, 2]
    return {
        "wheel_speed_rms": rms(wheels),
        "linear_rms": rms(twists[:, 0]),
        "angular_rms": rms(twists[:, 1]),
        "yaw_rms": rms(yaw),
        "end_pose": _apart(recorded.poses, twin.poses),
        "end_yaw": abs(float(yaw[-1])) if len(yaw) else math.nan,
        "end_odometry": _apart(recorded.odometry, twin.odometry),
        "time_shift": time_shift(stamps, recorded.feedback, own, twin.feedback),
    }


def residuals(recorded: Track, twin: Track, period: float) -> Floats:
    """Return recorded minus the twin's wheel speeds at each recorded line, (k, 4) [rad/s]."""
    stamps, own = steady(recorded.feedback_stamps, period), steady(twin.feedback_stamps, period)
    return recorded.feedback - _between(stamps, own, twin.feedback)


def rms(values: Floats) -> float:
    """Return the root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _between(wanted: Floats, stamps: Floats, values: Floats) -> Floats:
    """Interpolate rows linearly; NaN if there are none."""
    if not len(stamps):
        return np.full((len(wanted), values.shape[1]), np.nan)
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])


def _apart(one: Floats, other: Floats) -> float:
    """Return the distance of the last positions [m]; NaN if there are none."""
    if not len(one) or not len(other):
        return math.nan
    return float(np.hypot(*(one[-1, :2] - other[-1, :2])))


def time_shift(stamps: Floats, speeds: Floats, twin_stamps: Floats, twin_speeds: Floats) -> float:
    """Return by how much the twin's wheel speeds must be delayed to fit the recorded ones best [s].

    NaN if the wheels hardly move, or nothing within +-0.2 s fits best.
    """
    if len(stamps) < 3 or len(twin_stamps) < 3 or np.ptp(speeds, axis=0).max() < MOVING:
        return math.nan
    costs = np.array(
        [rms(speeds - _between(stamps - shift, twin_stamps, twin_speeds)) for shift in SHIFTS]
    )
    best = int(np.argmin(costs))
    if not 0 < best < len(SHIFTS) - 1:
        return math.nan
    left, middle, right = np.square(costs[best - 1 : best + 2])
    bend = left - 2.0 * middle + right
    part = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(SHIFTS[best] + part * (SHIFTS[1] - SHIFTS[0]))


def pooled(rows: Sequence[Figures], weights: Sequence[float]) -> Figures:
    """Combine figures of several episodes.

    Args:
        rows: figures of each episode.
        weights: their durations [s], for root mean squares; the others are means over episodes.
    """
    return {name: _pooled(name, [row[name] for row in rows], weights) for name in METRICS}


def _pooled(name: str, values: Sequence[float], weights: Sequence[float]) -> float:
    known = [(v, w) for v, w in zip(values, weights, strict=True) if math.isfinite(v)]
    if not known:
        return math.nan
    if METRICS[name].rms:
        total = sum(weight for _, weight in known)
        return math.sqrt(sum(value * value * weight for value, weight in known) / total)
    return sum(value for value, _ in known) / len(known)


def intervals(rows: Sequence[Figures]) -> dict[str, Interval]:
    """Return bootstrap intervals of the means over episodes; NaN for fewer than two."""
    return {name: bootstrap([row[name] for row in rows]) for name in METRICS}

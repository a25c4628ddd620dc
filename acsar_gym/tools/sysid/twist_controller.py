"""How a controller in ROS 2 turns twists into wheel speeds: by which separation of the wheels.

A twist says nothing of wheels. Where the controller's separation, its multiplier included, isn't
the one by which commands were made into twists, the sides of the robot differ by another share of
what was commanded. That share is found together with motors and delays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.kinematics import compute_sides, compute_twist
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board_log import (
    PAUSE_GAP,
    TURNING_SPEED,
    BoardTrack,
    Estimate,
    Floats,
    Identifiability,
    takes_twists,
)
from acsar_gym.tools.sysid.fit import SEARCHED_LAGS, MotorFit, estimate_spread, fit_motors
from acsar_gym.tools.sysid.parameter_findings import (
    INTERVAL_FACTOR,
    NORMAL_QUANTILE,
    ParameterFinding,
)
from acsar_gym.tools.sysid.response import lag_blend

with require_extra("identification", "scipy"):
    from scipy import signal

SEPARATION_NAME = "ros2.wheel_separation"
SEARCH_STEP = 0.005
"""Period of the filter of a first guess [s]."""
SEARCHED_DELAYS = np.arange(0.0, 0.4, 0.02)
"""Delays that are tried [s]."""
LEAST_SHARE, MOST_SHARE = 0.2, 5.0
"""Limits of the share; no robot is farther off."""
SAME_SHARE = 0.01
"""A controller whose separation differs by less is of the file's [share]."""
VAGUE_SHARE = 0.1
"""Half width of its interval above which it isn't told [share]."""
LEAST_HALF = 0.005
"""Least half width of its interval, whatever a log's length."""
MOST_FITS, SETTLED_SHARE = 4, 0.002
"""Most fits, of which each finds a better share, and a change of it that is none."""
SHARE_STEP = 1e-3
"""Step of its derivative."""


def fit_twists(
    tracks: Sequence[BoardTrack], config: RobotConfig, known: Identifiability
) -> tuple[MotorFit | None, list[ParameterFinding]]:
    """Fit motors and board as `fit_motors` does, and the controller where commands were twists.

    Args:
        tracks: of one robot.
        config: of the robot.
        known: what the tracks can tell.

    Returns:
        The fit, and the finding of the controller's separation, if there is one.
    """
    if not (takes_twists(tracks) and known.can("firmware.command_delay")):
        return fit_motors(tracks, config, known), []
    share = guess_share(tracks)
    if abs(share - 1.0) < SAME_SHARE:
        share = 1.0
    fit, change = None, Estimate(math.inf, 0.0, 0.0)
    for _ in range(MOST_FITS):
        fit = fit_motors([mix_sides(track, share) for track in tracks], config, known)
        if fit is None:
            return None, []
        change = _estimate_change(fit, share)
        better = share + change.value
        if abs(better - 1.0) < SAME_SHARE or share + change.low <= 1.0 <= share + change.high:
            better = 1.0
        if abs(better - share) < SETTLED_SHARE:
            break
        share = better
    own = config.twist_geometry[2]
    value, low, high = (own * (share + one) for one in change)
    found = ParameterFinding(SEPARATION_NAME, "", value, low, high, own, "as configured")
    if high - low > 2.0 * VAGUE_SHARE * own:
        found = ParameterFinding(SEPARATION_NAME, before=own, note="too vague: record more steps")
    elif abs(value / own - 1.0) > SAME_SHARE and not low <= own <= high:
        found = found.tell(value, low, high, "of its controller, the multiplier included")
    return fit, [found]


def mix_sides(track: BoardTrack, share: float) -> BoardTrack:
    """Return a track whose sides differ by a share of what they were commanded to differ."""
    return replace(track, commands=_mix_rows(track.commands, share))


def _mix_rows(speeds: Floats, share: float) -> Floats:
    middle = (speeds + speeds[:, [1, 0, 3, 2]]) / 2.0
    return np.asarray(middle + share * (speeds - middle))


def resend_twists(log: WireLog, sender: RobotConfig, robot: RobotConfig) -> WireLog:
    """Return a log of a robot in ROS with the commands that its controller made of the twists.

    Args:
        log: of the wire; of a board, it stays as it is.
        sender: by whose geometry commands were made into twists.
        robot: by whose geometry its controller takes them.
    """
    if not log.stamped or robot.ros2.command == "wheel_speeds":
        return log
    if np.allclose(sender.twist_geometry, robot.twist_geometry, rtol=SHARE_STEP, atol=0.0):
        return log

    stamps, speeds = log.commands(sender)
    letters = sender.wheels.motors
    lines = []
    for a, b, c, d in speeds.tolist():
        linear, angular = compute_twist(a, b, c, d, *sender.twist_geometry)
        right, left = compute_sides(linear, angular, *robot.twist_geometry, math.inf)
        taken = (right, left, left, right)
        lines.append(encode(letters.to_wire(taken) if letters else taken))
    return replace(log, sent_stamps=stamps, sent=tuple(lines))


def guess_share(tracks: Sequence[BoardTrack]) -> float:
    """Guess the share from speeds of a common lag and delay, which fit best."""
    least, best = math.inf, 1.0
    for lag in SEARCHED_LAGS:
        filtered = [_filter_sides(track, lag) for track in tracks]
        for delay in SEARCHED_DELAYS.tolist():
            rows, speeds = [], []
            for track, (edges, columns) in zip(tracks, filtered, strict=True):
                fast = np.abs(track.speeds).min(axis=1) > TURNING_SPEED
                fast &= ~_is_paused(track)
                times = track.stamps[fast] - delay
                rows.append(np.column_stack([np.interp(times, edges, one) for one in columns.T]))
                speeds.append(track.speeds[fast])
            regressors, measured = np.concatenate(rows), np.concatenate(speeds)
            if len(measured) < len(track.speeds[0]):
                return 1.0
            gains, cost, *_ = np.linalg.lstsq(regressors, measured, rcond=None)
            if len(cost) and cost.sum() < least:
                straight, turning = gains[0], gains[1] * (1.0, -1.0, -1.0, 1.0)
                least = float(cost.sum())
                best = float((straight @ turning) / (straight @ straight))
    return best if LEAST_SHARE < best < MOST_SHARE else 1.0


def _filter_sides(track: BoardTrack, lag: float) -> tuple[Floats, Floats]:
    """Times [s], and mean and half the difference of both sides' commands after a lag, (n, 2)."""
    edges = track.loop_edges(SEARCH_STEP)
    newest = np.searchsorted(track.arrivals, edges, side="right") - 1
    right, left = np.where(newest[:, None] < 0, 0.0, track.commands[newest])[:, :2].T
    sides = np.column_stack((right + left, right - left)) / 2.0
    blend = lag_blend(lag, SEARCH_STEP)
    return edges, np.asarray(signal.lfilter([blend], [1.0, blend - 1.0], sides, axis=0))


def _is_paused(track: BoardTrack) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which lines came in a pause of the commands, or up to a second later."""
    paused = np.zeros(len(track.stamps), np.bool_)
    for k in np.flatnonzero(np.diff(track.arrivals) > PAUSE_GAP):
        begin, end = track.arrivals[k], track.arrivals[k + 1] + 1.0
        paused |= (track.stamps > begin) & (track.stamps < end)
    return paused


def _estimate_change(fit: MotorFit, share: float) -> Estimate:
    """By how much the share must change, beside all fitted parameters: a step of Gauss-Newton."""
    problem, solution = fit.problem, fit.solution
    rest = problem.residuals(solution.x, solution.deadbands)
    moved = [mix_sides(track, 1.0 + SHARE_STEP / share) for track in problem.tracks]
    other = replace(problem, tracks=moved, kept={}).residuals(solution.x, solution.deadbands)
    jacobian = problem.jacobian(solution.x, solution.deadbands)[:, solution.free]
    columns = np.column_stack((jacobian, (other - rest) / SHARE_STEP))
    weights = (1.0 + (rest / solution.scale) ** 2) ** -0.25  # of soft_l1, on both sides
    step = np.linalg.lstsq(columns * weights[:, None], -rest * weights, rcond=None)[0]
    spread = estimate_spread(rest, columns, solution.scale, problem.blocks())
    half = NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(float(spread[-1, -1]))
    return Estimate.around(float(step[-1]), max(half, LEAST_HALF))

"""The board's command time-out, from pauses in the commands while wheels turn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from acsar_gym.identification.knowable import TURNING
from acsar_gym.identification.problem import Problem
from acsar_gym.identification.response import Clock, Wheel
from acsar_gym.identification.tracks import Track

STEP = 0.01
"""Distance of the candidates [s]."""
SLOWER = 0.6
"""Wheels below this share of their speed before the pause are stopping."""
TYPICAL = 0.15
"""Typical delay and lag, for a first guess [s]."""


def guess(tracks: Sequence[Track]) -> float:
    """A first guess of the time-out [s]; inf where wheels kept turning in every pause."""
    found = math.inf
    for track in tracks:
        for k in track.pauses:
            active = np.abs(track.commands[k]) >= TURNING
            inside = _inside(track, int(k))
            if not active.any() or not inside.any():
                continue
            share = np.mean(track.speeds[inside][:, active] / track.commands[k][active], axis=1)
            slower = np.flatnonzero(share < SLOWER * max(share[0], 0.5))
            if len(slower):
                after = track.stamps[inside][slower[0]] - track.arrivals[k]
                found = min(found, max(float(after) - TYPICAL, STEP))
    return found


def longest(tracks: Sequence[Track]) -> float:
    """The longest pause while wheels turned [s]."""
    gaps = [
        float(track.arrivals[k + 1] - track.arrivals[k])
        for track in tracks
        for k in track.pauses
        if np.abs(track.commands[k]).max() >= TURNING
    ]
    return max(gaps, default=0.0)


def refined(problem: Problem, motors: Sequence[Wheel], clock: Clock) -> float:
    """The time-out that explains the pauses best, within 0.4 s of the clock's [s]."""
    around = np.arange(-0.4, 0.4, STEP) + clock.timeout
    candidates = around[around > STEP]
    costs = []
    for timeout in candidates.tolist():
        other = clock._replace(timeout=timeout)
        rest = [problem.residuals_of(k, motor, other) for k, motor in enumerate(motors)]
        costs.append(float(np.abs(np.concatenate(rest)).sum()))
    return float(candidates[int(np.argmin(costs))])


def _inside(track: Track, k: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which readings were made in the pause after command k."""
    begin, end = track.arrivals[k], track.arrivals[k + 1]
    return np.asarray((track.stamps > begin + 0.02) & (track.stamps < end))

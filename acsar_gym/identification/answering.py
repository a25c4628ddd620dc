"""Checks that each wheel answers its own command; a miswired robot's motors can't be fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import IdentificationError
from acsar_gym.identification.knowable import SHORTEST
from acsar_gym.identification.tracks import Track
from acsar_gym.protocol import WHEELS

Floats = NDArray[np.float64]

LAGS = np.arange(0.0, 0.5, 0.02)
"""Delays of an answer that are tried [s]."""
TURNS = 0.5
"""A wheel that never exceeds this is dead; that is said elsewhere [rad/s]."""
SURE = 0.5
"""A wheel answers a command from this correlation on."""
CLEARLY = 0.3
"""By how much another wheel's command must explain it better than its own."""
ADVICE = (
    "run 'acsar-gym doctor DEVICE --spin --out FILE' first, and give the file as --robot; nothing "
    "was fitted"
)


def check(tracks: Sequence[Track]) -> None:
    """Check that no wheel is reversed or swapped; IdentificationError names the first that is.

    Short logs, from which nothing is fitted, aren't checked.
    """
    if sum(track.duration for track in tracks) < SHORTEST:
        return
    for wheel, name in enumerate(WHEELS):
        found = answers(tracks, wheel)
        best = int(np.argmax(np.abs(found)))
        if abs(found[best]) > max(SURE, abs(found[wheel]) + CLEARLY):
            way = " backward" if found[best] < 0.0 else ""
            raise IdentificationError(f"{name} answers {WHEELS[best]}'s command{way}: {ADVICE}")
        if found[wheel] < -SURE:
            raise IdentificationError(f"{name} turns backward at forward commands: {ADVICE}")


def answers(tracks: Sequence[Track], wheel: int) -> Floats:
    """Correlation of a wheel's speed with each wheel's command, at its best delay, (4,)."""
    speeds = np.concatenate([track.speeds[:, wheel] for track in tracks])
    if np.abs(speeds).max() < TURNS:
        return np.zeros(4)
    rows = []
    for lag in LAGS:
        commands = np.concatenate([_commands(track, float(lag)) for track in tracks])
        norm = np.sqrt((commands**2).sum(0) * (speeds @ speeds))
        rows.append(speeds @ commands / np.maximum(norm, 1e-9))
    high, low = np.max(rows, 0), np.min(rows, 0)
    return np.asarray(
        np.where(high >= -low - CLEARLY, high, low)
    )  # periodic commands have both signs


def _commands(track: Track, lag: float) -> Floats:
    """Commands that held this long before each line, (m, 4) [rad/s]; zero before the first."""
    newest = np.searchsorted(track.arrivals, track.stamps - lag, side="right") - 1
    return np.where(newest[:, None] < 0, 0.0, track.commands[newest])

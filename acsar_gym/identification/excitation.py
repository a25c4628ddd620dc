"""The wheel speeds that a manoeuvre commands: random steps, a staircase through zero, a pause."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig

Floats = NDArray[np.float64]

FASTEST = 10.0
"""Largest speed of the steps [rad/s]."""
SLOWEST = 2.0
"""Smallest speed of the steps [rad/s]."""
HOLD = (0.2, 0.7)
"""How long a step is held [s]."""
STAIR = 1.5
"""Top of the staircase [rad/s]; a larger deadband isn't found."""
PAUSE_SPEED = 6.0
"""Wheel speed before the pause [rad/s]."""
BEFORE_PAUSE = 1.2
"""How long that speed is held [s]."""
LONGEST_PAUSE = 2.3
"""How long commands stop at most [s]."""
SLOWER_AT_ZERO = 1.5
"""Exponent of the staircase, which lingers where small deadbands are."""
SHARES = (0.35, 0.40)
"""Parts of the manoeuvre, less pause, that the first steps and the staircase take."""
STAGGER = np.array([0.0, 0.5, 0.25, 0.75])
"""Where in its staircase each wheel starts, as a part of it."""


@dataclass(frozen=True)
class Plan:
    """Wheel speeds for each tick, (n, 4) [rad/s]; the pause lies between the two parts."""

    before: Floats
    after: Floats
    pause: int
    """Ticks without commands, at most."""


def plan(config: RobotConfig, duration: float, period: float, seed: int = 0) -> Plan:
    """Make the commands of a manoeuvre, different ones for each wheel.

    Args:
        config: of the robot; its top speeds limit the commands.
        duration: of the whole manoeuvre [s], at least 12.
        period: of a tick [s].
        seed: of the random steps.
    """
    rng = np.random.default_rng(seed)
    top = min(FASTEST, config.max_wheel_speed, config.max_linear / config.wheel_radius)
    moving = duration - LONGEST_PAUSE - BEFORE_PAUSE
    ticks = [round(share * moving / period) for share in SHARES]
    rest = round(moving / period) - sum(ticks)
    constant = np.array([1.0, -1.0, 1.0, -1.0]) * min(PAUSE_SPEED, top)
    before = (
        _steps(ticks[0], top, period, rng),
        _staircase(ticks[1], min(STAIR, top)),
        np.tile(constant, (round(BEFORE_PAUSE / period), 1)),
    )
    after = _steps(rest, top, period, rng)
    return Plan(np.concatenate(before), after, round(LONGEST_PAUSE / period))


def _steps(ticks: int, top: float, period: float, rng: np.random.Generator) -> Floats:
    """Speeds that jump at random times, independently for each wheel."""
    speeds = np.empty((ticks, 4))
    for wheel in range(4):
        k, sign = 0, 1.0
        while k < ticks:
            held = round(rng.uniform(*HOLD) / period)
            sign = -sign if rng.random() < 0.7 else sign
            speeds[k : k + held, wheel] = sign * rng.uniform(min(SLOWEST, top / 2.0), top)
            k += held
    return speeds


def _staircase(ticks: int, top: float) -> Floats:
    """Slow rise and fall through zero in both directions, each wheel at another place of it."""
    turn = (np.arange(ticks)[:, None] / ticks + STAGGER) % 1.0
    triangle = 1.0 - np.abs((4.0 * turn + 1.0) % 4.0 - 2.0)
    return np.asarray(-top * np.sign(triangle) * np.abs(triangle) ** SLOWER_AT_ZERO)

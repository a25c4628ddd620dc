"""What the board computes: ramps of set points, and the numbers that it prints."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.protocol import Speeds


@jit
def towards(value: float, target: float, step: float) -> float:
    """Move a value towards a target by at most `step`."""
    return min(max(target, value - step), value + step)


@loop
def ramped(set_points: Speeds, targets: Speeds, steps: Speeds) -> Speeds:
    """Move four set points [rad/s] towards their targets by at most their `steps`."""
    return (
        towards(set_points[0], targets[0], steps[0]),
        towards(set_points[1], targets[1], steps[1]),
        towards(set_points[2], targets[2], steps[2]),
        towards(set_points[3], targets[3], steps[3]),
    )


@loop
def printed(speed: float, quantum: float) -> float:
    """Round a measured speed [rad/s] to a multiple of the quantum.

    The last factor makes multiples that lie halfway between two numbers of two decimals round
    alike as text and in compiled code.
    """
    multiple: float = np.rint(speed / quantum) * quantum
    return multiple * (1.0 + 1e-12)

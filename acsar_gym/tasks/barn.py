"""The score of the BARN challenge (Xiao et al., ICRA 2022), for one run.

    score = success * OT / clip(AT, k * OT, 8 * OT)

OT, the optimal time, is the length of the world's path over a speed, AT the time the run took.
"""

from __future__ import annotations

import math

from acsar_gym.jit import compilable

TOLERANCE = 1.0
"""An odometry position this close to the goal is a success [m]."""
CHALLENGE_SPEED = 2.0
"""Speed of the challenge's optimal time [m/s]."""
SCORES = ("barn_score", "barn_score_k4", "barn_score_own", "barn_score_own_k4")
"""k = 2 (since 2024) and k = 4 (2022), at 2 m/s and at the robot's own top speed."""


@compilable
def score(success: float, time: float, length: float, speed: float, k: float) -> float:
    """From 0 to 1 / k; `success` is 1 or 0, `time` in s, `length` in m, `speed` in m/s.

    NaN for a length that is NaN: the goal wasn't the world's.
    """
    optimal = length / speed
    if math.isnan(optimal):
        return optimal
    return success * optimal / min(max(time, k * optimal), 8.0 * optimal)


@compilable
def scores(
    success: float, time: float, length: float, top_speed: float
) -> tuple[float, float, float, float]:
    """As SCORES names them."""
    return (
        score(success, time, length, CHALLENGE_SPEED, 2.0),
        score(success, time, length, CHALLENGE_SPEED, 4.0),
        score(success, time, length, top_speed, 2.0),
        score(success, time, length, top_speed, 4.0),
    )

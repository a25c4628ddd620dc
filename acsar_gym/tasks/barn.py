"""The score of the BARN challenge (Xiao et al., ICRA 2022), for one run.

    score = success * OT / clip(AT, k * OT, 8 * OT)

OT, the optimal time, is the length of the world's own path divided by a reference speed. AT is
the time that the run took.
"""

from __future__ import annotations

import math

from acsar_gym.jit import compilable

TOLERANCE = 1.0
"""The run is a success once odometry is this close to the goal [m]."""
CHALLENGE_SPEED = 2.0
"""The reference speed of the challenge [m/s]."""
SCORES = ("barn_score", "barn_score_k4", "barn_score_own", "barn_score_own_k4")
"""Names of the four scores in info: k = 2 (since 2024) and k = 4 (2022), each with the
challenge's reference speed of 2 m/s and with the robot's own top speed."""


@compilable
def score(success: float, time: float, length: float, speed: float, k: float) -> float:
    """Compute the score of one run.

    Args:
        success: 1 for a run that reached the goal, otherwise 0.
        time: that the run took [s].
        length: of the world's own path from start to goal [m]; NaN where there is none.
        speed: reference speed of the optimal time [m/s].
        k: a run faster than k times the optimal time earns no more.

    Returns:
        0 to 1 / k; NaN where `length` is NaN.
    """
    optimal = length / speed
    if math.isnan(optimal):
        return optimal
    return success * optimal / min(max(time, k * optimal), 8.0 * optimal)


@compilable
def scores(
    success: float, time: float, length: float, top_speed: float
) -> tuple[float, float, float, float]:
    """Compute the four scores of one run, in the order of SCORES.

    Args:
        success: 1 for a run that reached the goal, otherwise 0.
        time: that the run took [s].
        length: of the world's own path from start to goal [m]; NaN where there is none.
        top_speed: of the robot [m/s].
    """
    return (
        score(success, time, length, CHALLENGE_SPEED, 2.0),
        score(success, time, length, CHALLENGE_SPEED, 4.0),
        score(success, time, length, top_speed, 2.0),
        score(success, time, length, top_speed, 4.0),
    )

"""Episodes against recorded figures: any other number that they compute is seen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scenes import HALL, RANGES

EPISODES: dict[str, tuple[dict[str, Any], float, float]] = {
    "PointGoal-v0": (
        {"randomization": RANGES, "goal_distance": (0.5, 1.0)},
        19.996218326,
        -6.7487389109,
    ),
    "ObstacleGoal-v1": ({}, 14.609636893, -43.204722620),
    "Barn-v1": ({}, 16.832727763, -14.547230132),
    "Crowd-v0": ({"worlds": HALL}, 21.653350534, -48.057242572),
    "PathFollow-v0": ({}, -11.448396350, -22.510944975),
}
"""Arguments of an id, and the sums of its observations, with weights, and of its rewards."""


@pytest.mark.parametrize("name", EPISODES)
def test_step_computes_the_recorded_figures(name: str, make: Any) -> None:
    """They change with a new version of the package only."""
    arguments, *figures = EPISODES[name]
    env = make(f"acsar_gym/{name}", "planar", **arguments)
    rng = np.random.default_rng(5)
    ends = True
    observed = earned = 0.0
    for step in range(150):
        if ends:
            env.reset(seed=step)
        action = rng.uniform((0.2, -1.0), (1.0, 1.0)).astype(np.float32)
        observation, reward, *outcome, _ = env.step(action)
        ends = any(outcome)
        observed += observation @ np.cos(np.arange(len(observation)) + step)
        earned += reward
    assert [observed, earned] == pytest.approx(figures, rel=1e-4)

"""Episodes against recorded figures, and randomized episodes on every simulated link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import HALL, RANGES


@pytest.mark.parametrize(
    ("name", "arguments", "figures"),
    [
        (
            "PointGoal-v0",
            {"randomization": RANGES, "goal_distance": (0.5, 1.0)},
            [19.996218326, -6.7487389109],
        ),
        ("ObstacleGoal-v1", {}, [14.609636893, -43.204722620]),
        ("Barn-v1", {}, [16.832727763, -14.547230132]),
        ("Crowd-v0", {"worlds": HALL}, [21.653350534, -48.057242572]),
        ("PathFollow-v0", {}, [-11.448396350, -22.510944975]),
    ],
)
def test_step_computes_the_recorded_figures(
    name: str, arguments: dict[str, Any], figures: list[float], make: Any
) -> None:
    """Sums of observations, with weights, and of rewards: only a new version changes them."""
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


# Randomized episodes

POINT_GOAL = "acsar_gym/PointGoal-v0"


def draw_episodes(make: Any, link: Any, **options: Any) -> list[dict[str, list[float]]]:
    """What three episodes of one seed have drawn."""
    env = make(POINT_GOAL, link, randomization=RANGES, **options)
    infos = [env.reset(seed=seed)[1] for seed in (3, None, None)]
    return [
        {key: np.ravel(info[key]).tolist() for key in info if key.startswith("drawn_")}
        for info in infos
    ]


def test_randomization_draws_are_the_same_on_every_simulated_link(
    tmp_path: Path, make: Any
) -> None:
    planar = draw_episodes(make, "planar")
    assert list(planar[0]) == [f"drawn_{name}" for name in RANGES]
    assert planar[0] != planar[1] != planar[2]
    assert draw_episodes(make, "bullet") == planar
    assert draw_episodes(make, "planar", record=tmp_path / "tape.mcap") == planar

    for draws in planar:
        del draws["drawn_turn_factor"]  # it has no effect in MuJoCo
    assert draw_episodes(make, "mujoco") == planar


def test_randomization_is_alike_in_pybullet_and_planar(make: Any) -> None:
    """To a few millimetres: the odometry, through latency and slow feedback, and the truth."""
    ends = []
    for link in ("planar", "bullet"):
        env = make(POINT_GOAL, link, randomization=RANGES)
        env.reset(seed=8)
        for _ in range(10):
            *_, info = env.step(np.array([0.7, 0.3], np.float32))
        ends.append([info[key] for key in ("true_x", "true_y", "odom_x", "odom_y")])
    assert ends[0] == pytest.approx(ends[1], abs=5e-3)
    assert ends[0][0] > 0.2

"""Randomized episodes of the single env, on every simulated link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import RANGES

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

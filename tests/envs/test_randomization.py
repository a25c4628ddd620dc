"""Randomized episodes of the single env, on every simulated link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_tools import POINT_GOAL, Make
from varied import RANGES

from acsar_gym import open_link


def draw_episodes(make: Make, link: Any, **options: Any) -> list[dict[str, list[float]]]:
    """What three episodes of one seed have drawn."""
    env = make(POINT_GOAL, link, randomization=RANGES, **options)
    infos = [env.reset(seed=3)[1], env.reset()[1], env.reset()[1]]
    env.close()
    return [
        {key: np.ravel(info[key]).tolist() for key in info if key.startswith("drawn_")}
        for info in infos
    ]


def test_the_draws_are_the_same_on_every_simulated_link(tmp_path: Path, make: Make) -> None:
    planar = draw_episodes(make, "planar")
    assert list(planar[0]) == [f"drawn_{name}" for name in RANGES]
    assert planar[0] != planar[1] != planar[2]
    assert draw_episodes(make, "bullet") == planar
    assert draw_episodes(make, open_link("bullet")) == planar
    assert draw_episodes(make, "planar", record=tmp_path / "tape.mcap") == planar
    with_faults = draw_episodes(make, "planar", faults={"dropped_lines": 0.1})
    assert with_faults[0].keys() == planar[0].keys()

    for draws in planar:
        del draws["drawn_turn_factor"]  # it has no effect in MuJoCo
    assert draw_episodes(make, "mujoco") == planar


def test_pybullet_and_the_planar_robot_drive_alike_with_what_was_drawn(make: Make) -> None:
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

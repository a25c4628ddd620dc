"""Randomized episodes of the single env, on every simulated link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from varied import RANGES

from acsar_gym import open_link

ACTION = np.array([0.7, 0.3], np.float32)


def make(link: Any, **options: Any) -> gymnasium.Env[Any, Any]:
    env_id = "acsar_gym:acsar_gym/PointGoal-v0"
    return gymnasium.make(env_id, link=link, randomization=RANGES, **options)


def drawn(info: dict[str, Any]) -> dict[str, list[float]]:
    return {key: np.ravel(info[key]).tolist() for key in info if key.startswith("drawn_")}


def episodes(link: Any, **options: Any) -> list[dict[str, list[float]]]:
    """What three episodes of one seed have drawn."""
    env = make(link, **options)
    seen = [drawn(env.reset(seed=3)[1]), drawn(env.reset()[1]), drawn(env.reset()[1])]
    env.close()
    return seen


def test_the_draws_are_the_same_on_every_simulated_link(tmp_path: Path) -> None:
    planar = episodes("planar")
    assert list(planar[0]) == [f"drawn_{name}" for name in RANGES]
    assert planar[0] != planar[1] != planar[2]
    assert episodes("bullet") == planar
    applied = [dict(one) for one in planar]
    for one in applied:
        del one["drawn_turn_factor"]  # it has no effect in MuJoCo
    assert episodes("mujoco") == applied
    assert episodes(open_link("bullet")) == planar
    assert episodes("planar", record=tmp_path / "tape.mcap") == planar
    assert episodes("planar", faults={"dropped_lines": 0.1})[0].keys() == planar[0].keys()


def test_pybullet_and_the_planar_robot_drive_alike_with_what_was_drawn() -> None:
    """To a few millimetres: the odometry, through latency and slow feedback, and the truth."""
    ends = []
    for link in ("planar", "bullet"):
        env = make(link)
        env.reset(seed=8)
        for _ in range(10):
            *_, info = env.step(ACTION)
        ends.append([info[key] for key in ("true_x", "true_y", "odom_x", "odom_y")])
        env.close()
    assert ends[0] == pytest.approx(ends[1], abs=5e-3)
    assert ends[0][0] > 0.2

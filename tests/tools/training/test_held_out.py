"""Scores of a policy that is being trained."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.training import held_out
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.pool import Pool

WORLDS = "clutter:900-903"
STEPS = 60
ROBOTS = 6


def towards(seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Turn to the goal and drive, through whatever is there."""
    return np.stack([np.ones(len(seen)), np.clip(2.0 * seen[:, 2], -1.0, 1.0)], axis=1)


PEOPLE = World(
    start=Region(0.0, 0.0, 0.0, 0.0),
    goal=Region(4.0, 0.0),
    movers=[walk([[x, -1.0], [x, 1.0]], 1.0, spread=4.0) for x in (0.8, 1.6)],
)


@pytest.mark.parametrize("worlds", [WORLDS, PEOPLE], ids=["standing", "people"])
def test_a_score_is_what_evaluation_says_of_the_same_episodes(worlds: Any) -> None:
    batch = ObstacleGoalVectorEnv(ROBOTS, worlds=worlds, max_episode_steps=STEPS, threads=1)
    score = held_out.evaluate_held_out(batch, towards)
    batch.close()
    env = gymnasium.make(
        "acsar_gym/ObstacleGoal-v1", link="planar", worlds=worlds, max_episode_steps=STEPS
    )
    one = evaluation.run_episodes(
        env, lambda seen: towards(seen[None])[0], ROBOTS, FIRST_HELD_OUT_SEED
    )
    results = list(one)
    env.close()
    assert score.episodes == ROBOTS
    assert score.success_rate == pytest.approx(np.mean([r.success for r in results]))
    assert score.collision_rate == pytest.approx(np.mean([r.collision for r in results]))
    assert 0.0 < score.collision_rate < 1.0
    assert score.struck_rate == pytest.approx(np.mean([r.person_contact == 2.0 for r in results]))
    assert (score.struck_rate > 0.0) == (worlds is PEOPLE)
    ticks = np.mean([r.ticks for r in results])
    assert score.length == pytest.approx(ticks / 10.0)


def test_every_robot_counts_once_and_always_the_same() -> None:
    """Quick episodes aren't counted again while the slow ones go on."""
    options: dict[str, Any] = {"goal_distance": (0.3, 1.5), "max_episode_steps": 30}
    batch = PointGoalVectorEnv(16, **options, threads=1)
    scores = [held_out.evaluate_held_out(batch, towards) for _ in range(2)]
    batch.close()
    assert repr(scores[0]) == repr(scores[1])
    assert 0.0 < scores[0].success_rate < 1.0
    assert scores[0].success_rate * 16 == round(scores[0].success_rate * 16)
    assert scores[0].length < 30.0


@pytest.mark.parametrize(
    ("trained", "beside"),
    [
        ("barn", ["barn:900-963"]),
        ("clutter:1000", ["clutter:1000-1063"]),
        ("clutter:963-1100", ["clutter:1101-1164"]),
        ("clutter:964-1100", ["clutter:900-963"]),
        (["clutter:train", "barn:train"], ["clutter:900-931", "barn:900-931"]),
    ],
)
def test_held_out_worlds_are_others(trained: Any, beside: list[str]) -> None:
    assert held_out.choose_held_out_worlds(Pool.of(trained)) == beside


def test_beside_a_file_and_on_the_open_floor_there_are_no_other_worlds() -> None:
    assert held_out.choose_held_out_worlds(Pool.of(World(goal=Region(3.0, 0.0)))) is None
    assert held_out.choose_held_out_worlds(None) is None

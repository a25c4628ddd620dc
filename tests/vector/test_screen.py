"""Pictures of a batch: what they show, and Gymnasium's recorder of them."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from scenes import HALL

from acsar_gym.errors import ConfigError
from acsar_gym.render.top_view import MOVER_COLOUR
from acsar_gym.vector.screen import EMPTY_COLOUR, MAX_PICTURES


def make(env_id: str = "acsar_gym/ObstacleGoal-v1", robots: int = 3, **options: Any) -> Any:
    return gymnasium.make_vec(
        env_id, robots, "vector_entry_point", render_mode="rgb_array", threads=1, **options
    )


def test_render_draws_a_picture_of_each_robot_among_movers() -> None:
    env = make(robot=["acsar", "jackal", "acsar"], worlds=HALL)
    with pytest.raises(ConfigError, match="reset"):
        env.render()
    env.reset(seed=0)
    first = np.array(env.render())
    assert len({picture.tobytes() for picture in first}) == 3
    assert (first == MOVER_COLOUR).all(axis=3).sum(axis=(1, 2)).min() > 20

    # The movers move first, then the robots.
    env.step(np.zeros((3, 2)))
    standing = np.array(env.render())
    assert ((standing == MOVER_COLOUR) != (first == MOVER_COLOUR)).any(axis=(1, 2, 3)).all()
    env.step(np.tile([0.8, 0.3], (3, 1)))
    assert (np.array(env.render()) != standing).any(axis=(1, 2, 3)).all()
    env.reset(seed=0)
    assert (np.array(copy.deepcopy(env).render()) == first).all()


def test_render_draws_the_first_robots() -> None:
    env = make("acsar_gym/PointGoal-v0", 300)
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 300
    drawn = [(picture != EMPTY_COLOUR).any() for picture in pictures]
    assert drawn == [True] * MAX_PICTURES + [False] * (300 - MAX_PICTURES)
    assert pictures[0].shape[0] * 18 <= 1920  # all of them, as the recorder tiles them

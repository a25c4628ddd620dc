"""Pictures of a batch: what they show, and Gymnasium's recorder of them."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from mover_tools import HALL

from acsar_gym.errors import ConfigError
from acsar_gym.render.top_view import MOVER_COLOUR
from acsar_gym.vector.screen import EMPTY_COLOUR, MAX_PICTURES

OPTIONS: dict[str, dict[str, Any]] = {
    "acsar_gym/PointGoal-v0": {},
    "acsar_gym/ObstacleGoal-v1": {"worlds": "clutter:3"},
}


def make(env_id: str = "acsar_gym/PointGoal-v0", robots: int = 3, **options: Any) -> Any:
    options = {"render_mode": "rgb_array", "threads": 1, **OPTIONS.get(env_id, {}), **options}
    return gymnasium.make_vec(env_id, robots, "vector_entry_point", **options)


@pytest.mark.parametrize("env_id", OPTIONS)
def test_each_robot_has_a_picture_like_the_single_env_s(env_id: str) -> None:
    env = make(env_id, robot=["acsar", "jackal", "acsar"])
    env.reset(seed=0)
    first = env.render()
    assert [picture.shape for picture in first] == [first[0].shape] * 3
    assert len({picture.tobytes() for picture in first}) == 3
    env.step(np.tile([0.8, 0.3], (3, 1)))
    second = env.render()
    assert all((one != other).any() for one, other in zip(first, second, strict=True))
    env.reset(seed=0)
    assert all((one == other).all() for one, other in zip(first, env.render(), strict=True))
    env.close()


def test_what_moves_around_each_robot_is_in_its_picture() -> None:
    env = make("acsar_gym/ObstacleGoal-v1", 2, worlds=HALL, max_episode_steps=3)
    env.reset(seed=0)
    before = env.render()
    counts = [(picture == MOVER_COLOUR).all(axis=2).sum() for picture in before]
    assert min(counts) > 20
    for _ in range(2):
        env.step(np.zeros((2, 2)))
    assert all(moved(one, other) for one, other in zip(before, env.render(), strict=True))
    env.close()


def moved(one: Any, other: Any) -> bool:
    """Whether movers are elsewhere in two pictures."""
    return bool(((one == MOVER_COLOUR) != (other == MOVER_COLOUR)).any())


def test_the_first_robots_of_a_large_batch_are_drawn() -> None:
    env = make(robots=300)
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 300
    drawn = [(picture != EMPTY_COLOUR).any() for picture in pictures]
    assert drawn == [True] * MAX_PICTURES + [False] * (300 - MAX_PICTURES)
    assert pictures[0].shape[0] * 18 <= 1920  # all of them, as the recorder tiles them
    env.close()


def test_there_is_nothing_to_see_before_a_reset_or_without_the_mode() -> None:
    env = make()
    with pytest.raises(ConfigError, match="reset"):
        env.render()
    env.reset(seed=0)
    again = copy.deepcopy(env.unwrapped)
    again.step(np.zeros((3, 2)))
    assert len(again.render()) == 3
    plain = make(render_mode=None)
    plain.reset(seed=0)
    assert plain.render() is None
    for one in (env, again, plain):
        one.close()
    assert env.metadata["render_fps"] == 10

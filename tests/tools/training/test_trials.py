"""Trials of a sweep over levels of randomization."""

from __future__ import annotations

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training import seeds

pytestmark = pytest.mark.xdist_group("torch")


def test_a_trial_trains_and_gives_a_success_rate() -> None:
    assert 0.0 <= seeds.run_trial("point_goal", 3, seed=1, steps=1, count=2) <= 1.0


def test_a_recipe_has_the_ranges_of_its_level() -> None:
    (none,) = seeds.randomized_recipe("point_goal", 0).values()
    assert "randomization" not in none["env_kwargs"]
    friction = []
    for level in (1, 2, 3):
        (recipe,) = seeds.randomized_recipe("point_goal", level).values()
        low, high = recipe["env_kwargs"]["randomization"]["friction"]
        friction.append(high - low)
    assert friction == sorted(friction)
    with pytest.raises(ConfigError, match="must be 1, 2 or 3"):
        seeds.randomized_recipe("point_goal", 4)

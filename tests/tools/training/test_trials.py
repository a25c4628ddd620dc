"""Trials of the example that sweeps over levels of randomization."""

from __future__ import annotations

import runpy

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.resources import AGENTS

pytestmark = pytest.mark.xdist_group("torch")
EXAMPLE = runpy.run_path(str(AGENTS / "examples" / "tune_randomization.py"))


def test_a_trial_trains_and_gives_a_success_rate() -> None:
    done = EXAMPLE["trial"]({"level": 3, "seed": 1}, "point_goal", steps=1, episodes=2)
    assert 0.0 <= done["success"] <= 1.0


def test_a_recipe_has_the_ranges_of_its_level() -> None:
    (none,) = EXAMPLE["randomized_recipe"]("point_goal", 0).values()
    assert "randomization" not in none["env_kwargs"]
    friction = []
    for level in (1, 2, 3):
        (recipe,) = EXAMPLE["randomized_recipe"]("point_goal", level).values()
        low, high = recipe["env_kwargs"]["randomization"]["friction"]
        friction.append(high - low)
    assert friction == sorted(friction)
    with pytest.raises(ConfigError, match="must be 1, 2 or 3"):
        EXAMPLE["randomized_recipe"]("point_goal", 4)

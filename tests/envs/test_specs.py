"""Specs of the ids go through JSON, and have a threshold."""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_tools import IDS, inner, make
from gymnasium.envs.registration import EnvSpec

from acsar_gym import RobotConfig
from acsar_gym.links.faults import Faults
from acsar_gym.physics import Randomization
from acsar_gym.registration import snake_case
from acsar_gym.resources import AGENTS

ROBOT = RobotConfig.preset("acsar").with_(max_linear=0.7, lidar={"rays": 33})
ARRAYS: dict[str, Any] = {
    "goal_distance": np.array([0.5, 2.0]),
    "goal_tolerance": np.float32(0.25),
    "randomization": Randomization(mass=(1, 2)),
}


@pytest.mark.parametrize(
    ("env_id", "options"), [*((env_id, {}) for env_id in IDS), ("acsar_gym/PointGoal-v0", ARRAYS)]
)
def test_a_spec_goes_through_json(env_id: str, options: dict[str, Any]) -> None:
    env = make(env_id, robot=ROBOT, faults=Faults(dropped_lines=0.01), **options)
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert inner(again).robot.config == inner(env).robot.config == ROBOT
    assert vars(inner(again).task) == vars(inner(env).task)
    assert again.observation_space == env.observation_space
    (seen, told), (expected, info) = (one.reset(seed=5) for one in (again, env))
    assert (seen == expected).all()
    assert told.get("drawn_mass") == info.get("drawn_mass")
    for one in (again, env):
        one.close()


def test_a_batchs_spec_goes_through_json() -> None:
    many: Any = gymnasium.make_vec(
        "acsar_gym/PointGoal-v0", 2, vectorization_mode="vector_entry_point", robot=ROBOT
    )
    assert EnvSpec.from_json(many.spec.to_json()).kwargs["robot"] == ROBOT.model_dump(mode="json")
    many.close()


@pytest.mark.parametrize("env_id", IDS)
def test_an_id_has_a_reward_threshold_where_a_policy_comes_along(env_id: str) -> None:
    """Below what that policy reaches; a straight drive doesn't. Among people nobody solves all."""
    threshold = gymnasium.spec(env_id).reward_threshold
    name = snake_case(env_id.removeprefix("acsar_gym/").partition("-")[0])
    solved = (AGENTS / "policies" / f"{name}.onnx").exists() and name not in ("crowd", "dyna_barn")
    assert (threshold is not None) == solved
    manual = inspect.getdoc(type(make(env_id).unwrapped)) or ""
    told = f"`reward_threshold` {threshold:g}" if threshold else "`reward_threshold`"
    assert (told in manual) == (threshold is not None)

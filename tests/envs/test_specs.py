"""Specs of the ids go through JSON, and have a threshold."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from acsar_gym import RobotConfig
from acsar_gym.envs.ids import make_vec
from acsar_gym.links.faults import Faults
from acsar_gym.physics import Randomization
from acsar_gym.registration import snake_case
from acsar_gym.resources import AGENTS

POINT_GOAL = "acsar_gym/PointGoal-v0"
ROBOT = RobotConfig.preset("acsar").with_(max_linear=0.7, lidar={"rays": 33})
VALUES: dict[str, Any] = {
    "goal_distance": np.array([0.5, 2.0]),
    "goal_tolerance": np.float32(0.25),
    "randomization": Randomization(mass=(1, 2)),
    "weights": {"progress": np.float64(3.0)},
}


@pytest.mark.parametrize("options", [{}, VALUES])
def test_spec_goes_through_json(options: dict[str, Any], make: Any) -> None:
    env = make(POINT_GOAL, robot=ROBOT, faults=Faults(dropped_lines=0.01), **options)
    assert env.spec is not None
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert again.unwrapped.robot.config == env.unwrapped.robot.config == ROBOT
    assert vars(again.unwrapped.task) == vars(env.unwrapped.task)
    assert again.observation_space == env.observation_space
    assert repr(again.reset(seed=5)) == repr(env.reset(seed=5))
    again.close()


def test_spec_of_a_batch_goes_through_json() -> None:
    batch: Any = make_vec(POINT_GOAL, 2, robot=ROBOT)
    assert EnvSpec.from_json(batch.spec.to_json()).kwargs["robot"] == ROBOT.model_dump(mode="json")
    batch.close()


def test_reward_threshold_is_there_if_its_packaged_policy_solves_it(env_id: str) -> None:
    """Below what that policy reaches. No policy solves the ids with people."""
    threshold = gymnasium.spec(env_id).reward_threshold
    name = snake_case(env_id.removeprefix("acsar_gym/").partition("-")[0])
    has_policy = (AGENTS / "policies" / f"{name}.onnx").exists()
    assert (threshold is not None) == (has_policy and name not in ("crowd", "dyna_barn"))

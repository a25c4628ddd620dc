"""What RLlib gets of a batch and its network, without Ray."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from acsar_gym.errors import ConfigError
from acsar_gym.tools.policies import rllib

pytestmark = pytest.mark.xdist_group(__name__)
ASKED = {"id": "point_goal", "num_envs": 2}


def test_a_batch_is_the_same_but_for_info() -> None:
    quiet = rllib.make_batch(ASKED)
    mode = "vector_entry_point"
    plain = gymnasium.make_vec("acsar_gym/PointGoal-v0", 2, vectorization_mode=mode)
    actions = np.array([[0.5, 0.1], [1.0, -1.0]], np.float32)
    observations, info = quiet.reset(seed=3)
    np.testing.assert_array_equal(observations, plain.reset(seed=3)[0])
    *told, after = quiet.step(actions)
    for found, wanted in zip(told, plain.step(actions), strict=False):
        np.testing.assert_array_equal(found, wanted)
    assert info == after == {}


def test_options_reach_the_batch_and_bad_ones_are_refused() -> None:
    made: Any = rllib.make_batch({**ASKED, "options": {"policy_rate": 20.0}}).unwrapped
    assert made.ticks_per_step == 5
    with pytest.raises(ConfigError, match="SameStep"):
        rllib.make_batch({**ASKED, "options": {"autoreset_mode": AutoresetMode.SAME_STEP}})
    with pytest.raises(ConfigError, match="nonsense"):
        rllib.make_batch({**ASKED, "options": {"nonsense": 1}})


def test_the_mean_action_of_a_network() -> None:
    import torch

    class Module(torch.nn.Linear):
        def forward_inference(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
            return {"action_dist_inputs": self(batch["obs"])}

    module, seen = Module(7, 4), torch.ones(3, 7)
    with torch.no_grad():
        assert torch.equal(rllib.actor(module)(seen), module(seen)[:, :2])

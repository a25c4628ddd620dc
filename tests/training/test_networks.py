"""Networks of recipes: what they compute, and that their policies can be exported and timed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.policies import OnnxPolicy
from acsar_gym.policies.describing import described

pytestmark = pytest.mark.xdist_group("torch")
NUMBERS, RAYS = 7, 64
ODD = (2, 4, 6)


def space(width: int = NUMBERS + RAYS) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-2.0, 2.0, (width,))


def features(observation: np.ndarray[Any, Any], **options: Any) -> np.ndarray[Any, Any]:
    import torch

    from acsar_gym.training.networks import RayClearance

    extractor = RayClearance(space(len(observation)), **options)
    seen = torch.from_numpy(observation[None].astype(np.float32))
    numbers: np.ndarray[Any, Any] = extractor(seen).numpy()[0]
    return numbers


def test_the_last_centimetres_before_a_collision_are_told_apart() -> None:
    config = RobotConfig.of(None)
    ahead, left = NUMBERS + RAYS // 2, NUMBERS + 3 * RAYS // 4
    edge = {ahead: config.body.length / 2.0 - config.lidar_x_offset, left: config.body.width / 2.0}
    observation = np.full(NUMBERS + RAYS, 0.5)
    for clearance in (0.0, 0.02, 0.1, 1.0):
        for ray, distance in edge.items():
            observation[ray] = (distance + clearance) / config.lidar.max_range
        seen = features(observation)
        assert seen[list(edge)] == pytest.approx(0.5 * math.log(clearance + 0.05) + 0.4, abs=1e-4)
        assert seen[:NUMBERS] == pytest.approx(0.5)


def test_a_ray_inside_the_footprint_has_no_clearance() -> None:
    observation = np.zeros(NUMBERS + RAYS)
    assert features(observation)[NUMBERS:] == pytest.approx(0.5 * math.log(0.05) + 0.4)


def test_the_robot_and_the_place_of_the_rays_can_be_given() -> None:
    config = RobotConfig.of(None)
    few = config.with_(lidar={"rays": 8})
    observation = np.full(12, 0.5)
    seen = features(observation, robot=few, first=2)
    assert (np.abs(seen[2:10] - 0.5) > 0.01).all()
    assert seen[[0, 1, 10, 11]] == pytest.approx(0.5)
    with pytest.raises(ConfigError, match="no 8 rays in an observation of 12"):
        features(observation, robot=few, first=5)
    with pytest.raises(ConfigError, match="no 64 rays in an observation of 12"):
        features(observation)


def test_a_mirrored_scene_gets_the_mirrored_action_and_the_same_value() -> None:
    import torch

    policy = mirrored()
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.1, 1.0, (5, NUMBERS + RAYS)).astype(np.float32)
    image = seen.copy()
    image[:, ODD] *= -1.0
    image[:, NUMBERS:] = seen[:, NUMBERS + (-np.arange(RAYS)) % RAYS]
    with torch.no_grad():
        actions, images = (
            policy.get_distribution(torch.from_numpy(one)).mode().numpy() for one in (seen, image)
        )
        values, same = (policy.predict_values(torch.from_numpy(one)) for one in (seen, image))
    assert images == pytest.approx(actions * [1.0, -1.0], abs=1e-6)
    assert np.abs(actions).min() > 1e-4
    assert same.numpy() == pytest.approx(values.numpy(), abs=1e-5)


def mirrored(width: int = NUMBERS + RAYS, **options: Any) -> Any:
    import torch

    from acsar_gym.training.mirrored import MirrorPolicy
    from acsar_gym.training.networks import RayClearance

    torch.manual_seed(0)
    policy = MirrorPolicy(
        space(width),
        gymnasium.spaces.Box(-1.0, 1.0, (2,)),
        lambda _: 1e-3,
        **{
            "net_arch": [32, 32],
            "odd": ODD,
            "features_extractor_class": RayClearance,
            "activation_fn": torch.nn.ReLU,
            **options,
        },
    )
    for weights in policy.action_net.parameters():
        torch.nn.init.normal_(weights)
    return policy


def test_numbers_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(ConfigError, match="before 64 rays, of 71 features"):
        mirrored(odd=(7,))


def test_the_exported_network_acts_as_the_trained_one(tmp_path: Path) -> None:
    import torch

    from acsar_gym.policies import sb3_export

    env = ids.make_vec("acsar_gym/ObstacleGoal-v1", 1, worlds="clutter:1")
    width = len(env.single_observation_space.sample())
    policy = mirrored(width=width, odd=(2, 4, 6, 9))
    for bias in policy.mlp_extractor.actor.even:
        torch.nn.init.normal_(bias.bias)
    path = tmp_path / "policy.onnx"
    sb3_export.export(policy, path, described(env, "acsar_gym/ObstacleGoal-v1"))
    env.close()
    exported, rng = OnnxPolicy(path), np.random.default_rng(0)
    for _ in range(5):
        seen = rng.uniform(0.1, 1.0, width).astype(np.float32)
        with torch.no_grad():
            wanted = policy.get_distribution(torch.from_numpy(seen[None])).mode().numpy()[0]
        assert exported(seen) == pytest.approx(np.clip(wanted, -1.0, 1.0), abs=1e-5)


def test_a_saved_model_can_be_loaded(tmp_path: Path) -> None:
    import torch

    from acsar_gym.training.mirrored import MirrorPolicy

    policy = mirrored()
    policy.save(str(tmp_path / "policy.pt"))
    loaded = MirrorPolicy.load(str(tmp_path / "policy.pt"))
    seen = torch.rand(3, NUMBERS + RAYS)
    assert torch.equal(loaded.get_distribution(seen).mode(), policy.get_distribution(seen).mode())

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
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.describe import describe_policy
from acsar_gym.tools.training import networks
from acsar_gym.tools.training.networks import ARCS, ArcClearance, MirrorPolicy, RayClearance

pytestmark = pytest.mark.xdist_group(__name__)
NUMBERS, RAYS = 7, 64
ODD = (2, 4, 6)


def space(width: int = NUMBERS + RAYS) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-2.0, 2.0, (width,))


def features(observation: np.ndarray[Any, Any], **options: Any) -> np.ndarray[Any, Any]:
    import torch

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


@pytest.mark.parametrize("extractor", ["RayClearance", "ArcClearance"])
def test_a_mirrored_scene_gets_the_mirrored_action_and_the_same_value(extractor: str) -> None:
    import torch

    policy = mirrored(features_extractor_class=getattr(networks, extractor))
    seen = torch.from_numpy(
        np.random.default_rng(0).uniform(0.1, 1.0, (20, NUMBERS + RAYS)).astype(np.float32)
    )
    image = seen.clone()
    image[:, list(ODD)] *= -1.0
    image[:, NUMBERS + 1 :] = seen[:, NUMBERS + 1 :].flip(1)
    with torch.no_grad():
        actions, images = (policy.get_distribution(one).mode() for one in (seen, image))
        values, same = policy.predict_values(seen), policy.predict_values(image)
    mirrors = torch.isclose(images, actions * torch.tensor([1.0, -1.0]), atol=1e-3).all(dim=1)
    if extractor == "RayClearance":
        assert mirrors.all()
        assert torch.allclose(same, values, atol=1e-5)
    else:  # a point at the edge of a cell may fall to either side
        assert mirrors.float().mean() > 0.9
    assert actions.abs().min() > 1e-4


def mirrored(width: int = NUMBERS + RAYS, **options: Any) -> Any:
    import torch

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


def test_the_exported_network_acts_as_the_trained_one(tmp_path: Path) -> None:
    import torch

    from acsar_gym.tools.policies import sb3

    env = ids.make_vec("acsar_gym/ObstacleGoal-v1", 1, worlds="clutter:1")
    width = len(env.single_observation_space.sample())
    policy = mirrored(width=width, odd=(2, 4, 6, 9))
    for bias in policy.mlp_extractor.actor.even:
        torch.nn.init.normal_(bias.bias)
    path = tmp_path / "policy.onnx"
    sb3.export_policy(policy, path, describe_policy(env, "acsar_gym/ObstacleGoal-v1"))
    env.close()
    exported, rng = OnnxPolicy(path), np.random.default_rng(0)
    for _ in range(5):
        seen = rng.uniform(0.1, 1.0, width).astype(np.float32)
        with torch.no_grad():
            wanted = policy.get_distribution(torch.from_numpy(seen[None])).mode().numpy()[0]
        assert exported(seen) == pytest.approx(np.clip(wanted, -1.0, 1.0), abs=1e-5)


def arcs_seen(observation: np.ndarray[Any, Any]) -> dict[tuple[int, float], float]:
    """The free share of each arc, by its direction and curvature."""
    import torch

    extractor = ArcClearance(space(len(observation)))
    seen = extractor(torch.from_numpy(observation[None].astype(np.float32))).numpy()[0]
    assert len(seen) == extractor.features_dim == len(observation) + len(ARCS)
    shares = np.exp((seen[NUMBERS : NUMBERS + len(ARCS)] - 0.4) / 0.5) - 0.05
    return dict(zip(ARCS, shares.tolist(), strict=True))


def test_an_obstacle_ends_the_arcs_that_meet_it() -> None:
    """A point 0.5 m ahead of the front edge: straight on ends there, turns on the spot don't."""
    config = RobotConfig.of(None)
    observation = np.full(NUMBERS + RAYS, 1.0)
    front = config.body.length / 2.0
    observation[NUMBERS + RAYS // 2] = (
        front + 0.5 - config.lidar_x_offset
    ) / config.lidar.max_range
    seen = arcs_seen(observation)
    radius = math.hypot(front, config.body.width / 2.0)
    assert seen[1, 0.0] * 4.0 * radius == pytest.approx(0.5 - 0.125 * radius, abs=0.04)
    assert seen[0, 1.0] == seen[0, -1.0] == seen[-1, 0.0] == seen[1, 0.96] == pytest.approx(1.0)
    assert seen[1, 0.12] == pytest.approx(seen[1, -0.12], abs=0.021)
    assert seen[1, 0.12] < 1.0


def test_free_ways_are_those_of_a_footprint_that_is_driven_there() -> None:
    """Against points that are moved one by one, for a footprint that isn't a box."""
    from acsar_gym.config.footprint import border_distance, contains_point

    config = RobotConfig(footprint=((0.2, 0.0), (-0.15, 0.14), (-0.15, -0.14)))
    table, rng = networks.free_ways(config), np.random.default_rng(0)
    angles = np.linspace(-math.pi, math.pi, RAYS, endpoint=False)
    radius, size = 0.2052, networks.cell_length(config)
    for _ in range(40):
        ray, cell = int(rng.integers(RAYS)), int(rng.integers(5, 60))
        reach = (cell + 0.5) * size
        x = reach * math.cos(angles[ray]) + config.lidar_x_offset
        y = reach * math.sin(angles[ray]) + config.lidar_y_offset
        ways = np.arange(1, 51) / 50 * math.pi / 2
        back = [
            (x * math.cos(a) + y * math.sin(a), y * math.cos(a) - x * math.sin(a)) for a in ways
        ]
        met = [
            contains_point(config.outline, *p)
            or border_distance(config.outline, *p) < networks.TOUCH_MARGIN * radius
            for p in back
        ]
        first = met.index(True) / 50 if True in met else 1.0
        assert table[ray, cell, networks.ARCS.index((0, 1.0))] == pytest.approx(first, abs=0.021)

"""Networks of recipes: what they compute, and that their policies can be exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.sensors.map.courses import COURSES
from acsar_gym.sensors.map.movers import MOST_MOVERS, MOVER_NAMES
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tasks import ObstacleGoal
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.document import describe_policy
from acsar_gym.tools.policies.saving import planar_env
from acsar_gym.tools.training import recipes
from acsar_gym.tools.training.networks import MirrorPolicy

pytestmark = pytest.mark.xdist_group(__name__)
NAMES = (*ObstacleGoal.observation, *MAP_NAMES)
WIDTH = len(NAMES)
MIRRORED = ("goal_sin", "angular_velocity", "last_angular", "way_sin_0", "way_sin_1", "way_sin_2")
"""Numbers that change their sign in the mirror."""
MOVED = tuple(f"mover_{axis}_{n}" for n in range(MOST_MOVERS) for axis in ("y", "speed_y"))


def mirrored(width: int = WIDTH, env_id: str = "ObstacleGoal-v1", **options: Any) -> Any:
    import torch

    recipe = recipes.read_recipe("ppo", f"acsar_gym/{env_id}")
    kwargs = {**recipe.values["policy_kwargs"], "net_arch": [32, 32], **options}
    torch.manual_seed(0)
    box = gymnasium.spaces.Box(-2.0, 2.0, (width,))
    policy = MirrorPolicy(box, gymnasium.spaces.Box(-1.0, 1.0, (2,)), lambda _: 1e-3, **kwargs)
    for weights in policy.action_net.parameters():
        torch.nn.init.normal_(weights)
    return policy


@pytest.mark.parametrize(
    ("env_id", "names", "odd"),
    [
        ("ObstacleGoal-v1", NAMES, MIRRORED),
        ("Barn-v1", NAMES, MIRRORED),
        ("Crowd-v0", (*NAMES, *MOVER_NAMES), (*MIRRORED, *MOVED)),
        ("DynaBarn-v0", (*NAMES, *MOVER_NAMES), (*MIRRORED, *MOVED)),
    ],
)
def test_mirror_policy_mirrors_the_action_and_keeps_the_value(
    env_id: str, names: tuple[str, ...], odd: tuple[str, ...]
) -> None:
    """By the recipe's own indices, for a mirror image made from the numbers' names."""
    import torch

    policy = mirrored(len(names), env_id)
    assert policy.activation_fn is torch.nn.ReLU
    rng = np.random.default_rng(0)
    scene = torch.from_numpy(rng.uniform(0.1, 1.0, (20, len(names))).astype(np.float32))
    image = scene.clone()
    image[:, [names.index(name) for name in odd]] *= -1.0
    for stem in ("clearance", "arc", "wide_arc"):  # to the right becomes to the left
        group = [k for k, name in enumerate(names) if name.rpartition("_")[0] == stem]
        image[:, group] = scene[:, group[::-1]]
    for stem in ("contact", "gap") if len(names) > WIDTH else ():
        for course, (share, curvature) in enumerate(COURSES):
            mirrored_course = COURSES.index((share, -curvature))
            place, source = (names.index(f"{stem}_{n}") for n in (course, mirrored_course))
            image[:, place] = scene[:, source]
    with torch.no_grad():
        actions = policy.get_distribution(scene).mode()
        images = policy.get_distribution(image).mode()
        values = policy.predict_values(scene)
        assert torch.allclose(policy.predict_values(image), values, atol=1e-5)
    assert torch.allclose(images, actions * torch.tensor([1.0, -1.0]), atol=1e-4)
    assert actions.abs().min() > 1e-4


def test_mirror_policy_refuses_other_numbers() -> None:
    for options in ({"odd": (2, WIDTH)}, {"reversed_at": [(20, 10), (29, 4)]}):
        with pytest.raises(ConfigError, match=f"must be different ones of {WIDTH} numbers"):
            mirrored(**options)


def test_mirror_policy_acts_the_same_when_exported(tmp_path: Path) -> None:
    import torch

    from acsar_gym.tools.policies import sb3_export

    policy = mirrored()
    for weights in policy.mlp_extractor.parameters():
        torch.nn.init.normal_(weights, std=0.2)
    with planar_env("obstacle_goal", worlds="clutter:1") as env:
        document = describe_policy(env, "obstacle_goal", width=WIDTH)

    path = tmp_path / "policy.onnx"
    path.write_bytes(sb3_export.export_policy(policy, document))
    scenes = np.random.default_rng(0).uniform(0.1, 1.0, (5, WIDTH)).astype(np.float32)
    with torch.no_grad():
        expected = policy.get_distribution(torch.from_numpy(scenes)).mode().clamp(-1.0, 1.0)
    actions = [OnnxPolicy(path)(scene) for scene in scenes]
    assert actions == pytest.approx(expected.numpy(), abs=1e-5)

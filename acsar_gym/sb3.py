"""From stable-baselines3 to the robot: a trained actor as one ONNX file."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

from acsar_gym.errors import MissingExtraError
from acsar_gym.policy import ENV_ID, ENV_KEY, LAYOUT_KEY
from acsar_gym.tasks import POINT_GOAL_LAYOUT

try:
    import onnx
    import torch
    from stable_baselines3.common.policies import ActorCriticPolicy
except ImportError:
    raise MissingExtraError("exporting a stable-baselines3 model", "train") from None


class _Actor(torch.nn.Module):
    """The deterministic actor of an actor-critic policy: observation in, clipped mean out."""

    def __init__(self, policy: ActorCriticPolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        features: Any = self.policy.extract_features(observation, self.policy.pi_features_extractor)
        mean = self.policy.action_net(self.policy.mlp_extractor.forward_actor(features))
        return torch.clamp(mean, -1.0, 1.0)


def export(policy: ActorCriticPolicy, path: Path) -> None:
    """Write the deterministic actor of a trained policy to one ONNX file at `path`.

    The file maps `observation` (batch, 7) to `action` (batch, 2), float32, and carries the env's id
    and the observation's layout, which `OnnxPolicy` checks.
    """
    actor = _Actor(policy).eval().cpu()
    example = (torch.zeros(1, len(POINT_GOAL_LAYOUT)),)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, we don't
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
        program: Any = torch.onnx.export(
            actor,
            example,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: "batch"},),
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    onnx.helper.set_model_props(model, {ENV_KEY: ENV_ID, LAYOUT_KEY: ",".join(POINT_GOAL_LAYOUT)})
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)

"""PPO of TorchRL on a batch of robots.

    pip install "acsar_gym[train,fast]" torchrl
    python agents/examples/torchrl_ppo.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000

TorchRL resets envs itself: it wants `autoreset_mode="Disabled"`, and resets those whose episodes
have ended by `options={"reset_mask": ...}`. 300,000 steps take 17 s of one core (17,400 steps/s);
torchrl.onnx then reaches 100 of 100 goals.
"""

import argparse
import time
from typing import Any

import gymnasium
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from acsar_gym import policies

HIDDEN = {"num_cells": [64, 64], "activation_class": nn.Tanh}


def main(arguments: list[str] | None = None) -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="acsar_gym:acsar_gym/PointGoal-v0")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", type=int, default=256)
    parser.add_argument("--rollout", type=int, default=64, help="steps of a robot between updates")
    parser.add_argument("--out", default="torchrl.onnx")
    asked = parser.parse_args(arguments)

    torch.manual_seed(asked.seed)
    how: dict[str, Any] = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled"}
    batch = GymWrapper(gymnasium.make_vec(asked.env, asked.robots, **how))
    batch.set_seed(asked.seed)
    numbers = batch.observation_spec["observation"].shape[-1]
    mean_and_scale = nn.Sequential(MLP(numbers, 4, **HIDDEN), NormalParamExtractor())
    module = TensorDictModule(mean_and_scale, ["observation"], ["loc", "scale"])
    kind = {"distribution_class": TanhNormal, "return_log_prob": True}
    actor = ProbabilisticActor(module, in_keys=["loc", "scale"], **kind)
    critic = ValueOperator(MLP(numbers, 1, **HIDDEN), in_keys=["observation"])
    advantage = GAE(gamma=0.98, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0)
    adam, frames = torch.optim.Adam(loss.parameters(), 1e-3), asked.robots * asked.rollout
    started = time.perf_counter()
    collector = Collector(batch, actor, frames_per_batch=frames, total_frames=asked.steps)
    for rollout in collector:
        for _ in range(6):
            advantage(rollout)
            flat = rollout.reshape(-1)
            for part in flat[torch.randperm(frames)].split(frames // 4):
                losses = loss(part)
                adam.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                adam.step()
        print(f"mean reward of a step: {rollout['next', 'reward'].mean():.3f}")
    print(f"{asked.steps / (time.perf_counter() - started):,.0f} steps/s")
    policies.save(Mean(mean_and_scale), asked.env, asked.out)


class Mean(nn.Module):
    """The mean action of a TanhNormal."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to actions (batch, 2)."""
        mean: torch.Tensor = self.network(observation)[0]
        return mean.tanh()


if __name__ == "__main__":
    main()

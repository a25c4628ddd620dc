"""PPO of SBX (stable-baselines3 in JAX) on a batch of robots.

    pip install ".[train,fast]" sbx-rl
    python agents/examples/sbx_ppo.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000

SBX takes the VecEnv of stable-baselines3, so `sb3.make_batch` is all it needs; so do its SAC, TQC
and CrossQ. 300,000 steps take 11 s of one core (28,400 steps/s); sbx.onnx then reaches 100 of 100
goals.
"""

import time

import numpy as np
import torch
import tyro
from sbx import PPO

from acsar_gym.tools import policies
from acsar_gym.tools.policies import sb3


def actor(model: PPO) -> torch.nn.Module:
    """Copy the weights of the mean action to torch, whose networks can be exported."""
    weights = model.policy.actor_state.params["params"]
    layers: list[torch.nn.Module] = []
    for name in ("Dense_0", "Dense_1", "Dense_2"):
        kernel, bias = (np.asarray(weights[name][part]) for part in ("kernel", "bias"))
        layers += [torch.nn.Linear(*kernel.shape), torch.nn.Tanh()]
        layers[-2].load_state_dict({"weight": torch.tensor(kernel.T), "bias": torch.tensor(bias)})
    return torch.nn.Sequential(*layers[:-1])


def main(
    env: str = "acsar_gym:acsar_gym/PointGoal-v0",
    steps: int = 300_000,
    seed: int = 0,
    robots: int = 256,
    rollout: int = 64,
    out: str = "sbx.onnx",
) -> None:
    """Train and export; a robot makes `rollout` steps between updates."""
    batch, size = sb3.make_batch(env, robots), robots * rollout // 4
    numbers = {"n_steps": rollout, "batch_size": size, "n_epochs": 6, "seed": seed}
    model = PPO("MlpPolicy", batch, gamma=0.98, learning_rate=1e-3, **numbers)
    started = time.perf_counter()
    model.learn(steps)
    print(f"{model.num_timesteps / (time.perf_counter() - started):,.0f} steps/s")
    policies.save(actor(model), env, out)
    batch.close()


if __name__ == "__main__":
    tyro.cli(main)

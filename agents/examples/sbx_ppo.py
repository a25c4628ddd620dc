"""PPO of SBX (stable-baselines3 in JAX) on a batch of robots.

    pip install "acsar_gym[train,fast]" sbx-rl
    python agents/examples/sbx_ppo.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000

SBX takes the VecEnv of stable-baselines3, so `sb3.make_batch` is all it needs; so do its SAC, TQC
and CrossQ.

300,000 steps take 11 s of one core (28,400 steps/s); sbx.onnx then reaches 100 of 100 goals.
"""

import argparse
import time

import numpy as np
import torch
from sbx import PPO

from acsar_gym import policies
from acsar_gym.policies import sb3


def actor(model: PPO) -> torch.nn.Module:
    """Copy the weights of the mean action to torch, whose networks can be exported."""
    weights = model.policy.actor_state.params["params"]
    layers: list[torch.nn.Module] = []
    for name in ("Dense_0", "Dense_1", "Dense_2"):
        kernel, bias = (np.asarray(weights[name][part]) for part in ("kernel", "bias"))
        layers += [torch.nn.Linear(*kernel.shape), torch.nn.Tanh()]
        layers[-2].load_state_dict({"weight": torch.tensor(kernel.T), "bias": torch.tensor(bias)})
    return torch.nn.Sequential(*layers[:-1])


def main(arguments: list[str] | None = None) -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="acsar_gym:acsar_gym/PointGoal-v0")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", type=int, default=256)
    parser.add_argument("--rollout", type=int, default=64, help="steps of a robot between updates")
    parser.add_argument("--out", default="sbx.onnx")
    asked = parser.parse_args(arguments)

    batch = sb3.make_batch(asked.env, asked.robots)
    model = PPO(
        "MlpPolicy",
        batch,
        n_steps=asked.rollout,
        batch_size=asked.robots * asked.rollout // 4,
        n_epochs=6,
        gamma=0.98,
        learning_rate=1e-3,
        seed=asked.seed,
    )
    started = time.perf_counter()
    model.learn(asked.steps)
    print(f"{model.num_timesteps / (time.perf_counter() - started):,.0f} steps/s")
    policies.save(actor(model), asked.env, asked.out)
    batch.close()


if __name__ == "__main__":
    main()

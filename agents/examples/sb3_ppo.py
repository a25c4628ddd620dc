"""PPO of stable-baselines3 on a batch of robots, and the ONNX file that drives.

    pip install ".[train,fast]"
    python agents/examples/sb3_ppo.py --env acsar_gym/PointGoal-v0 --steps 300000

`sb3.make_batch` is the batch as the VecEnv that stable-baselines3 wants; its other algorithms and
those of sb3-contrib take it, too. `acsar-gym train` does the same with randomized robots and the
recipes of agents/recipes. 300,000 steps take 8 s of one core (37,700 steps/s); sb3.onnx then
reaches 100 of 100 goals.
"""

import time

import torch
import tyro
from stable_baselines3 import PPO

from acsar_gym.tools import policies
from acsar_gym.tools.policies import sb3


def main(
    env: str = "acsar_gym:acsar_gym/PointGoal-v0",
    steps: int = 300_000,
    seed: int = 0,
    robots: int = 256,
    rollout: int = 64,
    out: str = "sb3.onnx",
) -> None:
    """Train and export; a robot makes `rollout` steps between updates."""
    batch = sb3.make_batch(env, robots)
    model = PPO(
        "MlpPolicy",
        batch,
        n_steps=rollout,
        batch_size=robots * rollout // 4,
        n_epochs=6,
        gamma=0.98,
        learning_rate=1e-3,
        seed=seed,
        device="cpu",
    )
    started = time.perf_counter()
    model.learn(steps)
    print(f"{model.num_timesteps / (time.perf_counter() - started):,.0f} steps/s")
    model.save(out.replace(".onnx", ".zip"))
    actor = model.policy
    network = torch.nn.Sequential(actor.mlp_extractor.policy_net, actor.action_net)
    policies.save(network, env, out)
    batch.close()


if __name__ == "__main__":
    tyro.cli(main)

"""Train PPO on PointGoal and export the actor as one ONNX file.

    python agents/train.py --steps 150000 --out runs/point_goal

writes policy.onnx (what drives the robot), model.zip (to train on), checkpoints and TensorBoard
logs into the folder.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

import acsar_gym  # noqa: F401 - registers the env
from acsar_gym import sb3
from acsar_gym.errors import AcsarError, ConfigError


@dataclass(frozen=True)
class Options:
    """PPO on acsar_gym/PointGoal-v0."""

    steps: int = 150_000
    """Env steps in all."""
    out: Path = Path("runs/point_goal")
    """Folder for the policy, checkpoints and logs."""
    link: str = "planar"
    """Simulated link to train on: planar or bullet."""
    envs: int = 16
    """Environments stepped in turn."""
    seed: int = 0
    """Seed of everything random."""
    progress: bool = True
    """Show a progress bar."""


def train(options: Options) -> Path:
    """Train, save, export; returns the path of the ONNX file."""
    if min(options.steps, options.envs) < 1:
        raise ConfigError("--steps and --envs must be at least 1")
    torch.set_num_threads(1)  # the networks are too small to share out
    env = make_vec_env(
        lambda: gymnasium.make("acsar_gym/PointGoal-v0", link=options.link),
        n_envs=options.envs,
        seed=options.seed,
    )
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=256,
        batch_size=1024,
        n_epochs=10,
        learning_rate=1e-3,
        gamma=0.98,
        gae_lambda=0.95,
        ent_coef=0.0,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -0.5},
        seed=options.seed,
        device="cpu",
        tensorboard_log=str(options.out / "tensorboard"),
    )
    checkpoints = CheckpointCallback(
        save_freq=max(options.steps // (4 * options.envs), 1),
        save_path=str(options.out / "checkpoints"),
    )
    try:
        model.learn(options.steps, callback=checkpoints, progress_bar=options.progress)
    finally:
        env.close()
    model.save(options.out / "model.zip")
    policy = options.out / "policy.onnx"
    sb3.export(model.policy, policy)
    return policy


if __name__ == "__main__":
    try:
        print(f"policy written to {train(tyro.cli(Options))}")
    except AcsarError as error:
        print(f"train.py: {error}", file=sys.stderr)
        sys.exit(error.exit_code)

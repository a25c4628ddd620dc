"""Train PPO on thousands of planar robots and export the actor as one ONNX file.

    python agents/train.py --steps 600000 --out runs/point_goal

writes policy.onnx (what drives the robot), model.zip (to train on), checkpoints and TensorBoard
logs into the folder.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from acsar_gym import sb3
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.vector import PointGoalVectorEnv

EPISODE_STEPS = 200
ROLLOUT_STEPS = 64
RANDOMIZATION = {
    "friction": (0.7, 1.2),
    "motor_gain": (0.95, 1.05),
    "motor_lag": (0.6, 1.5),
    "wheel_radius": (0.98, 1.02),
    "latency": (0.0, 0.02),
}
"""What differs from robot to robot while training, so that the policy minds none of it."""


@dataclass(frozen=True)
class Options:
    """PPO on acsar_gym/PointGoal-v0."""

    steps: int = 600_000
    """Env steps in all."""
    out: Path = Path("runs/point_goal")
    """Folder for the policy, checkpoints and logs."""
    robots: int = 512
    """Robots stepped together."""
    seed: int = 0
    """Seed of everything random."""
    randomize: bool = True
    """Vary the robots' physics (see RANDOMIZATION)."""
    progress: bool = True
    """Show a progress bar."""


def train(options: Options) -> int:
    """Train, save, export; returns the exit code: 130 where Ctrl-C ended it early."""
    if min(options.steps, options.robots) < 1:
        raise ConfigError("--steps and --robots must be at least 1")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {options.out}: can't be written: {error.strerror}") from None
    env = sb3.BatchVecEnv(
        PointGoalVectorEnv(
            options.robots,
            max_episode_steps=EPISODE_STEPS,
            autoreset_mode="SameStep",
            randomization=RANDOMIZATION if options.randomize else None,
        )
    )
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=ROLLOUT_STEPS,
        batch_size=4096,
        n_epochs=6,
        learning_rate=1e-3,
        gamma=0.98,
        gae_lambda=0.95,
        ent_coef=0.0,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -0.5},
        seed=options.seed,
        device="cpu",
        tensorboard_log=str(options.out / "tensorboard"),
    )
    callbacks: list[BaseCallback] = [
        CheckpointCallback(
            save_freq=max(options.steps // (4 * options.robots), ROLLOUT_STEPS),
            save_path=str(options.out / "checkpoints"),
        )
    ]
    if options.progress:
        callbacks.append(sb3.TrainingProgress(options.steps, EPISODE_STEPS))
    interrupted = False
    try:
        model.learn(options.steps, callback=callbacks)
    except KeyboardInterrupt:
        interrupted = True
        for callback in callbacks:
            callback.on_training_end()
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
    finally:
        env.close()
    model.save(options.out / "model.zip")
    policy = options.out / "policy.onnx"
    sb3.export(model.policy, policy)
    print(f"policy written to {policy}")
    return 130 if interrupted else 0


if __name__ == "__main__":
    torch.set_num_threads(2)
    try:
        sys.exit(train(tyro.cli(Options, prog="acsar-gym train")))
    except AcsarError as error:
        print(f"acsar-gym train: {error}", file=sys.stderr)
        sys.exit(error.exit_code)

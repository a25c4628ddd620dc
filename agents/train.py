"""Train PPO on thousands of planar robots and export the actor as one ONNX file.

    python agents/train.py --env obstacle_goal --out runs/obstacle_goal

writes policy.onnx (what drives the robot), model.zip (to train on), checkpoints and TensorBoard
logs into the folder. --resume model.zip --trust trains one of those zips on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from acsar_gym import sb3, vectors
from acsar_gym.errors import AcsarError, ConfigError, PolicyError
from acsar_gym.policies import ZipPolicy, sb3_export
from acsar_gym.vector import RobotVectorEnv

RANDOMIZATION = {
    "friction": (0.7, 1.2),
    "motor_gain": (0.95, 1.05),
    "motor_lag": (0.6, 1.5),
    "wheel_radius": (0.98, 1.02),
    "latency": (0.0, 0.02),
}
"""What differs from robot to robot while training, so that the policy minds none of it."""


@dataclass(frozen=True)
class Recipe:
    """What works for one environment."""

    env: Callable[..., RobotVectorEnv]
    steps: int
    episode_steps: int
    net: tuple[int, ...] = (64, 64)
    gamma: float = 0.98
    rollout_steps: int = 64
    batch_size: int = 4096
    epochs: int = 6
    learning_rate: float = 1e-3
    options: dict[str, Any] = field(default_factory=dict)
    """Arguments of the env."""


RECIPES = {
    "point_goal": Recipe(vectors.PointGoalVectorEnv, 600_000, 200),
    "path_follow": Recipe(vectors.PathFollowVectorEnv, 1_000_000, 400),
    "obstacle_goal": Recipe(
        vectors.ObstacleGoalVectorEnv,
        6_000_000,
        400,
        net=(128, 128),
        gamma=0.99,
        batch_size=8192,
        epochs=5,
        learning_rate=7e-4,
        options={"worlds": "clutter:train"},
    ),
    "barn": Recipe(
        vectors.BarnVectorEnv,
        15_000_000,
        1000,
        net=(256, 128),
        gamma=0.99,
        batch_size=8192,
        epochs=5,
        learning_rate=5e-4,
        options={"worlds": "barn:train"},
    ),
}
"""Worlds to train in begin at number 1000, so that the first ones are left to be evaluated in."""


@dataclass(frozen=True)
class Options:
    """PPO on one of the environments."""

    env: Literal["point_goal", "path_follow", "obstacle_goal", "barn"] = "point_goal"
    """What to learn; each has its own hyperparameters (see RECIPES)."""
    steps: int | None = None
    """Env steps to train; the recipe's where it isn't given."""
    out: Path | None = None
    """Folder for the policy, checkpoints and logs; runs/ENV where it isn't given."""
    robots: int = 512
    """Robots stepped together."""
    seed: int = 0
    """Seed of everything random."""
    worlds: str | None = None
    """Kind, file or folder of worlds, instead of the recipe's."""
    robot: str | None = None
    """Preset or config file."""
    randomize: bool = True
    """Vary the robots' physics (see RANDOMIZATION)."""
    progress: bool = True
    """Show a progress bar."""
    resume: Path | None = None
    """PPO's model.zip to train on, with the hyperparameters that are in it; needs --trust."""
    trust: bool = False
    """Let the zip of --resume run its code: only your own, or whose you trust."""


def train(options: Options) -> int:
    """Train, save, export; returns the exit code: 130 where Ctrl-C ended it early."""
    recipe = RECIPES[options.env]
    steps = recipe.steps if options.steps is None else options.steps
    if min(steps, options.robots) < 1:
        raise ConfigError("--steps and --robots must be at least 1")
    saved = ZipPolicy(options.resume, trust=options.trust) if options.resume else None
    out = _folder(options)
    env = _env(recipe, options)
    logs = str(out / "tensorboard")
    model = _resumed(saved, env, options, logs) if saved else _new(recipe, env, options, logs)
    sb3.label(model, env.task, env.config)
    callbacks: list[BaseCallback] = [
        CheckpointCallback(
            save_freq=max(steps // (4 * options.robots), recipe.rollout_steps),
            save_path=str(out / "checkpoints"),
        )
    ]
    if options.progress:
        callbacks.append(sb3.TrainingProgress(steps, recipe.episode_steps))
    interrupted = False
    try:
        model.learn(steps, callback=callbacks, reset_num_timesteps=saved is None)
    except KeyboardInterrupt:
        interrupted = True
        for callback in callbacks:
            callback.on_training_end()
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
    finally:
        env.close()
    model.save(out / "model.zip")
    policy = out / "policy.onnx"
    sb3_export.export(model.policy, policy, env.task, env.config)
    print(f"policy written to {policy}")
    return 130 if interrupted else 0


def _new(recipe: Recipe, env: RobotVectorEnv, options: Options, logs: str) -> PPO:
    return PPO(
        "MlpPolicy",
        sb3.BatchVecEnv(env),
        n_steps=recipe.rollout_steps,
        batch_size=recipe.batch_size,
        n_epochs=recipe.epochs,
        learning_rate=recipe.learning_rate,
        gamma=recipe.gamma,
        gae_lambda=0.95,
        ent_coef=0.0,
        policy_kwargs={"net_arch": list(recipe.net), "log_std_init": -0.5},
        seed=options.seed,
        device="cpu",
        tensorboard_log=logs,
    )


def _resumed(saved: ZipPolicy, env: RobotVectorEnv, options: Options, logs: str) -> PPO:
    saved.check(env.task, env.config)
    if not isinstance(saved.network, ActorCriticPolicy):
        raise PolicyError(f"{saved.path}: only PPO's models can be trained on")
    batch = sb3.BatchVecEnv(env)
    return PPO.load(saved.path, batch, device="cpu", seed=options.seed, tensorboard_log=logs)


def _folder(options: Options) -> Path:
    out = options.out or Path("runs") / options.env
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: can't be written: {error.strerror}") from None
    return out


def _env(recipe: Recipe, options: Options) -> RobotVectorEnv:
    arguments = dict(recipe.options)
    if options.worlds is not None:
        arguments["worlds"] = options.worlds
    if options.env == "point_goal" and options.worlds is not None:
        raise ConfigError("--worlds: point_goal has none")
    return recipe.env(
        options.robots,
        options.robot,
        max_episode_steps=recipe.episode_steps,
        autoreset_mode="SameStep",
        randomization=RANDOMIZATION if options.randomize else None,
        **arguments,
    )


if __name__ == "__main__":
    torch.set_num_threads(2)
    try:
        sys.exit(train(tyro.cli(Options, prog="acsar-gym train")))
    except AcsarError as error:
        print(f"acsar-gym train: {error}", file=sys.stderr)
        sys.exit(error.exit_code)

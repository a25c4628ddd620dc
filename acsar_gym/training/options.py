"""What a training is asked for at the command line."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.errors import ConfigError, MissingExtraError, shown
from acsar_gym.training import held_out

MOST_STEPS = 10**10
MOST_ROBOTS = 16_384
"""A rollout of so many takes 0.2 to 1 GB."""
MOST_WIDTH = 4096
"""Of a layer."""


@dataclass(frozen=True)
class Options:
    """PPO on one of the environments."""

    env: Annotated[str, tyro.conf.arg(metavar="NAME|ID")] = "point_goal"
    """point_goal, path_follow, obstacle_goal, barn, or an id as in mine.module:mine/Task-v0."""
    steps: int | None = None
    """Env steps to train, at most 10 billion; the recipe's where it isn't given."""
    out: Path | None = None
    """Folder for the policy, checkpoints and logs; runs/ENV where it isn't given."""
    robots: int = 512
    """Robots stepped together, at most 16,384."""
    seed: int = 0
    """Seed of everything random, 0 to 2^32 - 1."""
    threads: int | None = None
    """Cores to use; as many as are free when the training begins where it isn't given."""
    worlds: str | None = None
    """Kind, file or folder of worlds, instead of the env's own."""
    robot: str | None = None
    """Preset or config file."""
    randomize: bool = True
    """Vary the robots' physics (see RANDOMIZATION)."""
    gamma: float | None = None
    """Discount of a step, 0 to 1; the recipe's where it isn't given."""
    learning_rate: float | None = None
    """Of Adam, up to 1; the recipe's where it isn't given."""
    net: tuple[int, ...] | None = None
    """Widths of the hidden layers, as in 64 64; the recipe's where it isn't given."""
    progress: bool = True
    """Show a progress bar."""
    resume: Path | None = None
    """PPO's model.zip to train on, with the hyperparameters that are in it; needs --trust."""
    trust: bool = False
    """Let the zip of --resume run its code: only your own, or whose you trust."""

    def check(self) -> None:
        """Find whatever can be known to be wrong before anything is started.

        Raises:
            ConfigError: a number that is out of its range.
            MissingExtraError: a library that training needs isn't installed.
        """
        ranges = (
            ("steps", self.steps, 1, MOST_STEPS),
            ("robots", self.robots, 1, MOST_ROBOTS),
            ("seed", self.seed, 0, held_out.FIRST_SEED - 1),
            ("gamma", self.gamma, 0, 1),
            ("learning-rate", self.learning_rate, 0, 1),
            *(("net", width, 1, MOST_WIDTH) for width in self.net or ()),
        )
        for name, value, least, most in ranges:
            if value is not None and not least <= value <= most:
                raise ConfigError(f"--{name} {shown(value)}: must be {least:,} to {most:,}")
        for module in ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript"):
            try:
                missing = find_spec(module) is None
            except ImportError:
                missing = True
            if missing:
                raise MissingExtraError("training", "train")

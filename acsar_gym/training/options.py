"""Command line options of a training."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.errors import ConfigError, MissingExtraError, shown, suggestion
from acsar_gym.training import held_out
from acsar_gym.training.algorithms import algorithm

MOST_STEPS = 10**10
MOST_ROBOTS = 16_384
"""Most robots; a rollout of this many takes 0.2 to 1 GB."""
MOST_WIDTH = 4096
"""Largest width of a layer."""
DEVICES = ("cpu", "cuda")


@dataclass(frozen=True)
class Options:
    """Train a policy on one of the environments and export it as one ONNX file."""

    env: Annotated[str, tyro.conf.arg(metavar="NAME|ID")] = "point_goal"
    """point_goal, path_follow, obstacle_goal, barn, or an id as in mine.module:mine/Task-v0."""
    algo: Annotated[str, tyro.conf.arg(metavar="ppo|sac|tqc|ppo_lstm")] = "ppo"
    """Algorithm, by RL Zoo's names."""
    conf_file: Path | None = None
    """Recipe file in RL Zoo's format, or the config.yml of an earlier training; default:
    agents/recipes/ALGO.yml."""
    modules: tuple[str, ...] = ()
    """Modules of your own whose classes the recipe names, such as mine.networks; they are imported,
    which a recipe alone can't do. The module of --env is one of them."""
    steps: int | None = None
    """Env steps to train, at most 10 billion; default: the recipe's."""
    target: float | None = None
    """End once this share of 512 held-out episodes succeeds, such as 0.97; default: never."""
    out: Path | None = None
    """Folder for the policy, checkpoints and logs; default: runs/ENV."""
    robots: int | None = None
    """Robots stepped together, at most 16,384; default: the recipe's."""
    seed: int = 0
    """Seed of everything random, 0 to 2^32 - 1."""
    seeds: Annotated[str | None, tyro.conf.arg(metavar="0-4|1,5,9")] = None
    """Train these seeds instead of one, each in a folder of its own, and compare them."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --seeds: trainings at a time; default: one, or with --address one for each CPU."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT|auto|local")] = None
    """With --seeds: Ray cluster to train on."""
    device: Annotated[str, tyro.conf.arg(metavar="cpu|cuda")] = "cpu"
    """Where the networks are trained; the robots are simulated on the CPU."""
    threads: int | None = None
    """Cores to use; default: as many as are free when the training begins."""
    worlds: str | None = None
    """Generator, file or folder of worlds, instead of the env's own."""
    robot: str | None = None
    """Preset or config file."""
    randomize: bool = True
    """Randomize the robots' physics, within what was measured (`measured` in the robot's file) and
    default widths for the rest."""
    gamma: float | None = None
    """Discount factor, 0 to 1; default: the recipe's."""
    learning_rate: float | None = None
    """Learning rate of Adam, up to 1; default: the recipe's."""
    net: tuple[int, ...] | None = None
    """Widths of the hidden layers, such as 64 64; default: the recipe's."""
    progress: bool = True
    """Show a progress bar."""
    checkpoint_seconds: float = 60.0
    """Time between two checkpoints [s]."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER|model.zip")] = None
    """Folder of a training that was killed, to go on where its newest checkpoint is; or a model.zip
    to train on in a new training, with the hyperparameters in it. Needs --trust."""
    trust: bool = False
    """Allow the zips of --resume to run code in them: only for zips from people you trust."""

    def check(self) -> None:
        """Check all options before the training starts.

        Raises:
            ConfigError: a number is out of its range, or a name is unknown.
            MissingExtraError: a library that training needs isn't installed.
        """
        ranges = (
            ("steps", self.steps, 1, MOST_STEPS),
            ("robots", self.robots, 1, MOST_ROBOTS),
            ("seed", self.seed, 0, held_out.FIRST_SEED - 1),
            ("gamma", self.gamma, 0, 1),
            ("learning-rate", self.learning_rate, 0, 1),
            ("target", self.target, 0, 1),
            ("checkpoint-seconds", self.checkpoint_seconds, 0, 86_400),
            *(("net", width, 1, MOST_WIDTH) for width in self.net or ()),
        )
        for name, value, least, most in ranges:
            number = isinstance(value, int | float)  # config.yml may have been edited
            if value is not None and not (number and least <= value <= most):
                raise ConfigError(f"--{name} {shown(value)}: must be {least:,} to {most:,}")
        algorithm(self.algo)
        if self.seeds is None and (self.workers, self.address) != (None, None):
            raise ConfigError("--workers and --address: train several seeds: give --seeds, too")
        if self.device not in DEVICES:
            raise ConfigError(f"--device {self.device}: unknown{suggestion(self.device, DEVICES)}")
        for module in ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript"):
            try:
                missing = find_spec(module) is None
            except ImportError:
                missing = True
            if missing:
                raise MissingExtraError("training", "train")

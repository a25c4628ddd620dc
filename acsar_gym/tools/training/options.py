"""The options of `acsar-gym train`. Imports nothing slow."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import tyro
from pydantic import Field, model_validator

from acsar_gym.config.section import Section, Share
from acsar_gym.errors import ConfigError

ALGORITHMS = {
    "ppo": ("stable_baselines3", "PPO"),
    "sac": ("stable_baselines3", "SAC"),
    "tqc": ("sb3_contrib", "TQC"),
    "ppo_lstm": ("sb3_contrib", "RecurrentPPO"),
}
"""Module and class of each algorithm, by RL Zoo's names."""
FIRST_HELD_OUT_SEED = 2**32
"""First seed of held-out episodes. Seeds of a training are smaller."""


def parse_count(text: str) -> int:
    """Return a whole number of a text such as "150000" or "1e6"."""
    number = float(text)
    if not number.is_integer():
        raise ValueError(f"{text} isn't a whole number")
    return int(number)


COUNT = tyro.constructors.PrimitiveConstructorSpec(
    nargs=1,
    metavar="INT",
    instance_from_str=lambda words: parse_count(words[0]),
    is_instance=lambda value: value is None or isinstance(value, int),
    str_from_instance=lambda value: [str(value)],
)


class TrainingOptions(Section):
    """Train a policy on one of the environments and export it as one ONNX file."""

    section = "train"
    env: Annotated[str, tyro.conf.arg(metavar="NAME|ID")] = "point_goal"
    """point_goal, path_follow, obstacle_goal, barn, crowd, dyna_barn, or an id as in
    mine.module:mine/Task-v0."""
    algo: Literal["ppo", "sac", "tqc", "ppo_lstm"] = "ppo"
    """Algorithm, by RL Zoo's names."""
    conf_file: Path | None = None
    """Recipe file, or the config.yml of an earlier training. Default: agents/recipes/ALGO.yml."""
    steps: Annotated[int | None, COUNT, Field(ge=1, le=10**10)] = None
    """Env steps to train, such as 1e6, at most 10 billion. Default: the recipe's."""
    target: Share | None = None
    """End when this share of 512 held-out episodes succeeds, such as 0.97. Default: never."""
    out: Path | None = None
    """New or empty folder for the policy, checkpoints and logs. Default: runs/ENV/1, 2, ..."""
    robots: Annotated[int | None, COUNT, Field(ge=1, le=16_384)] = None
    """Robots stepped together, at most 16,384. Default: the recipe's."""
    seed: Annotated[int, Field(ge=0, lt=FIRST_HELD_OUT_SEED)] = 0
    """Seed of everything random, 0 to 2^32 - 1."""
    seeds: Annotated[str | None, tyro.conf.arg(metavar="0-4|1,5,9")] = None
    """Train these seeds instead of one, each in a folder of its own, and compare them."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --seeds: trainings at a time. Default: one, or with --address one for each CPU."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT|auto|local")] = None
    """With --seeds: Ray cluster to train on, whose machines share the folder."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks are trained. The robots are simulated on the CPU."""
    threads: int | None = None
    """Cores to use. Default: all that this process may use."""
    worlds: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND|PATH")
    ] = ()
    """Generator, file or folder of worlds, instead of the env's own. Repeat it for several, as
    in --worlds clutter:train --worlds barn:train."""
    robot: str | None = None
    """Preset, config file or drawn robot, or a fleet, such as drawn:train."""
    randomize: bool = True
    """Randomize the robots' physics, within what was measured (`measured` in the robot's file) and
    default widths for the rest."""
    gamma: Share | None = None
    """Discount factor, 0 to 1. Default: the recipe's."""
    learning_rate: Share | None = None
    """Learning rate of Adam, up to 1. Default: the recipe's."""
    net: tuple[Annotated[int, Field(ge=1, le=4096)], ...] | None = None
    """Widths of the hidden layers, such as 64 64. Default: the recipe's."""
    progress: bool = True
    """Show a progress bar on terminals, and print the scores."""
    checkpoint_seconds: Annotated[float, Field(ge=0, le=86_400)] = 60.0
    """Time between two checkpoints [s]."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER|model.zip")] = None
    """Folder of a training to go on with, at its newest file, or a model.zip to train on in a new
    training, with the hyperparameters in it. Needs --trust."""
    trust: bool = False
    """Allow the zips of --resume to run code in them: only zips from people you trust."""
    warm_up: bool = False
    """Only compile everything and generate the worlds, which the first training else waits for."""

    @model_validator(mode="after")
    def _check_seeds(self) -> Self:
        """Check the options that only several seeds have."""
        if self.seeds is None and (self.workers, self.address) != (None, None):
            raise ConfigError("--workers and --address: train several seeds: add --seeds")
        if self.seeds is not None and self.resume is not None:
            raise ConfigError("--resume: goes on with one training: leave out --seeds")
        return self

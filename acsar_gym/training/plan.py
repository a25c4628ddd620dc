"""What a training does: the user's options, and the settings that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics import Randomization, measured
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.training import held_out, recipes, threads
from acsar_gym.training.algorithms import Algorithm, algorithm
from acsar_gym.training.options import Options
from acsar_gym.training.recipes import Recipe
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.settings import FAIR_SHARE

RANDOMIZATION = "randomization"
"""Argument of an env that only the robots of the training get."""
MOST_EVALUATIONS = 16
STEPS_BETWEEN = 100_000
"""Least env steps between two held-out evaluations, which take up to 5 % of the time."""
MORE_EVALUATIONS = 3
"""How many times more often is evaluated to end at a target."""


@dataclass(frozen=True)
class Plan:
    """A training."""

    options: Options
    env_id: str
    algorithm: Algorithm
    recipe: Recipe
    episode_steps: int
    """Time limit of an episode [steps]."""
    threads: int
    out: Path
    robot: RobotConfig

    @classmethod
    def of(cls, options: Options) -> Plan:
        """Derive the settings of a training and create its folder.

        Args:
            options: the user's options.

        Raises:
            ConfigError: the env isn't registered, has no time limit or no worlds, the recipe
                can't be used, or the folder or the number of threads can't be used.
        """
        env_id = ids.registered(options.env)
        own = ids.without_module(env_id)
        limit = gymnasium.spec(own).max_episode_steps
        if limit is None:
            raise ConfigError(f"env {options.env}: has no max_episode_steps, training needs one")
        if options.worlds is not None and own == "acsar_gym/PointGoal-v0":
            raise ConfigError("--worlds: point_goal has none")
        count = threads.chosen(options.threads)
        robot = RobotConfig.of(options.robot)
        out, kind = _folder(options, own), algorithm(options.algo)
        modules = [*options.modules, *filter(None, [env_id.rpartition(":")[0]])]
        recipe = recipes.recipe(kind, own, options.conf_file, modules).with_(
            steps=options.steps,
            robots=options.robots,
            gamma=options.gamma,
            learning_rate=options.learning_rate,
            net=options.net,
        )
        return cls(options, env_id, kind, recipe, limit, count, out, robot)

    @property
    def randomization(self) -> Randomization:
        """What every episode of the training draws anew: the recipe's ranges if it has any."""
        if not self.options.randomize:
            return Randomization()
        ranges = self.recipe.env_kwargs.get(RANDOMIZATION)
        return Randomization.of(True if ranges is None else ranges, self.robot)

    @property
    def evaluations(self) -> int:
        """Held-out evaluations during the training, at most."""
        most = MOST_EVALUATIONS * (1 if self.options.target is None else MORE_EVALUATIONS)
        return max(1, min(most, self.recipe.steps // STEPS_BETWEEN))

    def learning(self) -> RobotVectorEnv:
        """Make the batch of robots to train on."""
        robots = self.recipe.robots
        return ids.make_vec(
            self.env_id,
            robots,
            robot=self.options.robot,
            autoreset_mode="SameStep",
            threads=max(1, min(self.threads, robots // FAIR_SHARE)),
            randomization=self.randomization,
            **self._arguments,
        )

    def held_out(self, learning: RobotVectorEnv) -> RobotVectorEnv:
        """Make the batch to evaluate on: no randomization, and worlds that aren't trained in."""
        few = self.options.target is None
        robots = held_out.ROBOTS if few else held_out.ROBOTS_FOR_TARGET
        arguments = self._arguments
        beside = held_out.worlds_beside(learning.pool, robots)
        if beside is not None:
            arguments["worlds"] = beside
        count = 1 if few else max(1, min(self.threads, robots // FAIR_SHARE))
        robot = self.options.robot
        return ids.make_vec(self.env_id, robots, robot=robot, threads=count, **arguments)

    @property
    def _arguments(self) -> dict[str, Any]:
        """Arguments of the env: the recipe's, and the worlds if the user gave some."""
        worlds = self.options.worlds
        given = {key: each for key, each in self.recipe.env_kwargs.items() if key != RANDOMIZATION}
        return given | ({} if worlds is None else {"worlds": worlds})

    def __str__(self) -> str:
        cores = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        found = self.options.randomize and measured.told(self.robot)
        return f"{cores}, seed {self.options.seed}" + (f"; {found}" if found else "")


def _folder(options: Options, env_id: str) -> Path:
    """Create the folder of a training."""
    short = options.env if "/" not in options.env else env_id.rpartition("/")[2]
    out = options.out or Path("runs") / short
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: can't be written: {error.strerror}") from None
    return out

"""The settings of a training, which follow from the user's options."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium

from acsar_gym.config import drawn
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.physics import randomization
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.recipes import Recipe, read_recipe
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.threads import ROBOTS_PER_THREAD, check_threads, usable_cores
from acsar_gym.worlds import registry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.sets import name_sources

HELD_OUT_ROBOTS = 64
"""Robots in an evaluation during training. Each runs one episode."""
TARGET_ROBOTS = 512
"""Robots in an evaluation that decides about a target: few leave the rate uncertain."""
MAX_EVALUATIONS = 16
MIN_STEPS_BETWEEN = 100_000
"""Least env steps between two held-out evaluations, which take up to 5 % of the time."""
TARGET_EVALUATIONS = 3
"""How many times more often is evaluated to end at a target."""
FEW_UPDATES = 30
"""Fewer updates of the policy are hardly enough to learn anything."""


class Score(NamedTuple):
    """Rates and means over held-out episodes, a row of the learning curve."""

    steps: int
    """Env steps of the training."""
    seconds: float
    """Time since the start of the training."""
    success_rate: float
    collision_rate: float
    """Touched an obstacle, or ran into somebody."""
    struck_rate: float
    """Somebody ran into the robot."""
    mean_return: float
    mean_length: float
    """Policy steps of an episode."""


@dataclass(frozen=True)
class TrainingPlan:
    """The settings of a training, which follow from the user's options."""

    options: TrainingOptions
    env_id: str
    """Id of the env, with the module that registers it."""
    recipe: Recipe
    episode_steps: int
    """Time limit of an episode [steps]."""
    threads: int

    @classmethod
    def of(cls, options: TrainingOptions) -> TrainingPlan:
        """Derive the settings of a training. Writes nothing."""
        env_id = ids.find_id(options.env)
        package, _, bare_id = env_id.rpartition(":")
        limit = gymnasium.spec(bare_id).max_episode_steps
        if limit is None:
            raise ConfigError(f"env {options.env}: has no max_episode_steps, training needs one")
        # It takes worlds, but sees no obstacles.
        if options.worlds and bare_id == "acsar_gym/PointGoal-v0":
            raise ConfigError("--worlds: point_goal has none")

        # Options take precedence over the recipe.
        recipe = read_recipe(options.algo, bare_id, options.conf_file, package).with_changes(
            n_timesteps=options.steps,
            n_envs=options.robots,
            net=options.net,
            gamma=options.gamma,
            learning_rate=options.learning_rate,
        )
        wanted = options.threads
        return cls(
            options,
            env_id,
            recipe,
            episode_steps=limit,
            threads=usable_cores() if wanted is None else check_threads("--threads", wanted),
        )

    @property
    def randomization(self) -> Any:
        """What every episode of the training draws: the recipe's ranges if it has any."""
        return self.options.randomize and self.recipe.env_kwargs.get("randomization", True)

    @property
    def held_out_robots(self) -> int:
        """Robots in an evaluation."""
        return HELD_OUT_ROBOTS if self.options.target is None else TARGET_ROBOTS

    @property
    def evaluation_interval(self) -> int:
        """Steps between two held-out evaluations."""
        limit = MAX_EVALUATIONS * (1 if self.options.target is None else TARGET_EVALUATIONS)
        count = max(1, min(limit, self.recipe.steps // MIN_STEPS_BETWEEN))
        return max(1, self.recipe.steps // count)

    @property
    def update_hint(self) -> str:
        """How few updates of the policy there will be. Empty if they are enough."""
        steps = self.recipe.steps
        rollout = self.recipe.count_rollout_steps(self.options.algo)
        updates = math.ceil(steps / rollout / self.recipe.robots)
        robots = int(steps / rollout / FEW_UPDATES)
        if updates >= FEW_UPDATES or robots < 1:
            return ""
        return (
            f"{steps:,} steps of {self.recipe.robots} robots are only {updates} "
            f"update{'s' * (updates != 1)} of the policy: choose --robots {robots} or fewer"
        )

    def make_training_batch(self) -> RobotVectorEnv:
        """Make the batch of robots to train on."""
        robot = self.options.robot
        return self._make_batch(self.recipe.robots, robot, randomization=self.randomization)

    def make_held_out_batch(self, training: RobotVectorEnv) -> RobotVectorEnv:
        """Make the batch to evaluate on: no randomization, other worlds, and other drawn robots."""
        robot = self.options.robot
        if drawn.PREFIX in (robot or ""):
            robot = "drawn:validation"
        worlds = choose_held_out_worlds(training.pool, self.held_out_robots)
        changes = {"worlds": worlds} if worlds else {}
        return self._make_batch(self.held_out_robots, robot, **changes)

    def _make_batch(self, count: int, robot: str | None, **changes: Any) -> RobotVectorEnv:
        """Make a batch with the arguments of the recipe, the user's worlds, and `changes`."""
        arguments = {**self.recipe.env_kwargs, "randomization": None, "robot": robot}
        arguments["autoreset_mode"] = "SameStep"
        if self.options.worlds:
            arguments["worlds"] = name_sources(self.options.worlds)
        # A thread with few robots waits longer than it works.
        arguments["threads"] = max(1, min(self.threads, count // ROBOTS_PER_THREAD))
        return ids.make_vec(self.env_id, count, **arguments | changes)

    def describe(self, training: RobotVectorEnv, held_out: RobotVectorEnv) -> Iterator[str]:
        """Yield lines about the training, before it starts."""
        # The first line names what two trainings must share to be compared.
        worlds = "training on an open floor"
        if training.pool is not None:
            worlds = f"training in {training.pool}, evaluated in {held_out.pool}"
        cores = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        ranges = self.options.randomize and randomization.describe_ranges(training.config)
        yield f"{worlds}; {cores}, seed {self.options.seed}" + (f"; {ranges}" if ranges else "")
        if self.options.resume is None and self.update_hint:
            yield self.update_hint
        if misfit := training.config.misfit:
            yield f"{self.options.robot}: {misfit}"


def choose_held_out_worlds(pool: Pool | None, robots: int = HELD_OUT_ROBOTS) -> list[str] | None:
    """Choose held-out worlds.

    Returns:
        For each set of generated worlds a set of the same generator without any of its worlds:
        those of the validation split, or those behind the set's if it has some of them. None for
        files and an open floor, which have no others, so that only the seeds differ.
    """
    if pool is None or not pool.generated:
        return None
    # Equal shares of each set, so that the score is of the same mixture.
    names = []
    count = robots // len(pool.sets)
    for group in pool.sets:
        split = registry.split_numbers(group.kind, registry.VALIDATION)
        overlaps = group.numbers[0] <= split[-1] and group.numbers[-1] >= split[0]
        first = group.numbers[-1] + 1 if overlaps else split[0]
        names.append(f"{group.generator}:{first}-{first + count - 1}")
    return names

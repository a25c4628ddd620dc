"""The settings of a training, which follow from the user's options."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium

from acsar_gym.config import RobotConfig, drawn
from acsar_gym.config.fleet import make_fleet
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics import randomization
from acsar_gym.tools.training import held_out
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.recipes import Recipe, load_algorithm, read_recipe
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.threads import ROBOTS_PER_THREAD, check_threads, usable_cores
from acsar_gym.worlds.sets import place_worlds

RANDOMIZATION_KEY = "randomization"
"""Argument of an env that only the robots of the training get."""
MAX_EVALUATIONS = 16
MIN_STEPS_BETWEEN = 100_000
"""Least env steps between two held-out evaluations, which take up to 5 % of the time."""
TARGET_EVALUATIONS = 3
"""How many times more often is evaluated to end at a target."""
FEW_UPDATES = 30
"""Fewer updates of the policy are hardly enough to learn anything."""
PROBE_TIME = 0.25
"""Duration of the measurement of free cores [s]."""


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
        """Derive the settings of a training; writes nothing."""
        env_id = ids.find_id(options.env)
        bare_id = ids.strip_module(env_id)
        limit = gymnasium.spec(bare_id).max_episode_steps
        if limit is None:
            raise ConfigError(f"env {options.env}: has no max_episode_steps, training needs one")
        if options.worlds and bare_id == "acsar_gym/PointGoal-v0":
            raise ConfigError("--worlds: point_goal has none")

        package = env_id.rpartition(":")[0]
        recipe = read_recipe(options.algo, bare_id, options.conf_file, package).with_changes(
            n_timesteps=options.steps,
            n_envs=options.robots,
            net=options.net,
            gamma=options.gamma,
            learning_rate=options.learning_rate,
        )
        if options.threads is None:
            threads = measure_free_cores()
        else:
            threads = check_threads("--threads", options.threads)
        return cls(options, env_id, recipe, episode_steps=limit, threads=threads)

    @property
    def short_name(self) -> str:
        """Name of the env in the names of folders."""
        return self.options.env.rpartition("/")[2]

    @cached_property
    def robots(self) -> tuple[RobotConfig, ...]:
        """The robot, or those of a fleet."""
        return make_fleet(self.options.robot).robots

    @property
    def randomization(self) -> Any:
        """What every episode of the training draws: the recipe's ranges if it has any."""
        ranges = self.recipe.env_kwargs.get(RANDOMIZATION_KEY)
        return self.options.randomize and (True if ranges is None else ranges)

    @property
    def evaluation_interval(self) -> int:
        """Steps between two held-out evaluations."""
        limit = MAX_EVALUATIONS * (1 if self.options.target is None else TARGET_EVALUATIONS)
        count = max(1, min(limit, self.recipe.steps // MIN_STEPS_BETWEEN))
        return max(1, self.recipe.steps // count)

    @property
    def update_hint(self) -> str:
        """How few updates there will be, and which --robots gives more; empty for enough."""
        steps = self.recipe.steps
        robots = self.recipe.robots
        rollout = self.recipe.steps_per_update(load_algorithm(self.options.algo))
        if rollout is None or (updates := math.ceil(steps / (rollout * robots))) >= FEW_UPDATES:
            return ""

        fewer = max(1, steps // (rollout * 2 * FEW_UPDATES))
        more_updates = math.ceil(steps / (rollout * fewer))
        if more_updates <= updates:
            return ""
        return (
            f"{steps:,} steps of {robots} robots are {updates} update{'s' * (updates > 1)} of the "
            f"policy, few to learn from: with --robots {fewer} there are {more_updates}"
        )

    def make_training_batch(self) -> RobotVectorEnv:
        """Make the batch of robots to train on."""
        robots = self.recipe.robots
        return ids.make_vec(
            self.env_id,
            robots,
            robot=self.options.robot,
            autoreset_mode="SameStep",
            threads=self._count_threads(robots),
            randomization=self.randomization,
            **self._arguments,
        )

    def make_held_out_batch(self, training: RobotVectorEnv) -> RobotVectorEnv:
        """Make the batch to evaluate on: no randomization, other worlds, and other drawn robots."""
        has_target = self.options.target is not None
        robots = held_out.TARGET_ROBOTS if has_target else held_out.HELD_OUT_ROBOTS
        arguments = self._arguments
        worlds = held_out.choose_held_out_worlds(training.pool, robots)
        if worlds is not None:
            arguments["worlds"] = worlds
        robot = self.options.robot
        if drawn.PREFIX in (robot or ""):
            robot = "drawn:validation"
        threads = self._count_threads(robots) if has_target else 1
        return ids.make_vec(self.env_id, robots, robot=robot, threads=threads, **arguments)

    def _count_threads(self, robots: int) -> int:
        return max(1, min(self.threads, robots // ROBOTS_PER_THREAD))

    @property
    def _arguments(self) -> dict[str, Any]:
        """Arguments of the env: the recipe's, and the user's worlds."""
        arguments = dict(self.recipe.env_kwargs)
        arguments.pop(RANDOMIZATION_KEY, None)
        if self.options.worlds:
            arguments["worlds"] = place_worlds(self.options.worlds, None, None)
        return arguments

    def describe(self, worlds: str) -> Iterator[str]:
        """Yield lines about the training, before it starts."""
        cores = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        ranges = self.options.randomize and randomization.describe_ranges(self.robots[0])
        yield f"{worlds}; {cores}, seed {self.options.seed}" + (f"; {ranges}" if ranges else "")
        if self.options.resume is None and (hint := self.update_hint):
            yield hint
        if misfit := self.robots[0].misfit:
            yield f"{self.options.robot}: {misfit}"


def measure_free_cores() -> int:
    """Measure how many cores other programs leave free, at least 1; takes PROBE_TIME seconds."""
    with require_extra("training", "train"):
        import psutil  # noqa: PLC0415 - optional
    idle = psutil.cpu_times_percent(interval=PROBE_TIME).idle / 100.0
    return max(1, min(usable_cores(), round(idle * (psutil.cpu_count() or 1))))

"""What a training does: the user's options, and the settings that follow from them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Self

import gymnasium
import tyro
from pydantic import Field, model_validator

from acsar_gym.config import RobotConfig, drawn
from acsar_gym.config.fleet import make_fleet
from acsar_gym.config.section import Section
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, require_extra, suggest_name
from acsar_gym.physics import Randomization, randomization
from acsar_gym.tools.training import held_out, recipes
from acsar_gym.tools.training.recipes import Algorithm, Recipe, find_algorithm
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.threads import ROBOTS_PER_THREAD, check_threads, usable_cores
from acsar_gym.worlds.sets import place_worlds

MAX_STEPS = 10**10
MAX_ROBOTS = 16_384
"""Most robots; a rollout of this many takes 0.2 to 1 GB."""
MAX_LAYER_WIDTH = 4096
"""Largest width of a layer."""
TORCH_DEVICES = ("cpu", "cuda")
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


class TrainingOptions(Section):
    """Train a policy on one of the environments and export it as one ONNX file."""

    section = "train"
    env: Annotated[str, tyro.conf.arg(metavar="NAME|ID")] = "point_goal"
    """point_goal, path_follow, obstacle_goal, barn, crowd, dyna_barn, or an id as in
    mine.module:mine/Task-v0."""
    algo: Annotated[str, tyro.conf.arg(metavar="ppo|sac|tqc|ppo_lstm")] = "ppo"
    """Algorithm, by RL Zoo's names."""
    conf_file: Path | None = None
    """Recipe file in RL Zoo's format, or the config.yml of an earlier training; default:
    agents/recipes/ALGO.yml."""
    conf_entry: str | None = None
    """Entry of that file, such as Pendulum-v1 of RL Zoo's; default: the one of the env's id, or
    "default"."""
    modules: tuple[str, ...] = ()
    """Modules of your own whose classes the recipe names, such as mine.networks; they are imported,
    which a recipe alone can't do. The module of --env is one of them."""
    steps: Annotated[int, Field(ge=1, le=MAX_STEPS)] | None = None
    """Env steps to train, at most 10 billion; default: the recipe's."""
    target: Annotated[float, Field(ge=0, le=1)] | None = None
    """End once this share of 512 held-out episodes succeeds, such as 0.97; default: never."""
    out: Path | None = None
    """Folder for the policy, checkpoints and logs, with no other training in it; default:
    runs/ENV, or runs/ENV-2 and so on where there is one already."""
    robots: Annotated[int, Field(ge=1, le=MAX_ROBOTS)] | None = None
    """Robots stepped together, at most 16,384; default: the recipe's."""
    seed: Annotated[int, Field(ge=0, lt=held_out.FIRST_HELD_OUT_SEED)] = 0
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
    worlds: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND|PATH")
    ] = ()
    """Generator, file or folder of worlds, instead of the env's own; give it again for worlds of
    several, as in --worlds clutter:train --worlds barn:train."""
    start: Annotated[str | None, tyro.conf.arg(metavar="X,Y,THETA")] = None
    """Where the robot starts in a world of a file [m, rad]."""
    goal: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """Where the goal is in a world of a file [m]."""
    robot: str | None = None
    """Preset, config file or drawn robot; or a fleet, such as drawn:train."""
    randomize: bool = True
    """Randomize the robots' physics, within what was measured (`measured` in the robot's file) and
    default widths for the rest."""
    gamma: Annotated[float, Field(ge=0, le=1)] | None = None
    """Discount factor, 0 to 1; default: the recipe's."""
    learning_rate: Annotated[float, Field(ge=0, le=1)] | None = None
    """Learning rate of Adam, up to 1; default: the recipe's."""
    net: tuple[Annotated[int, Field(ge=1, le=MAX_LAYER_WIDTH)], ...] | None = None
    """Widths of the hidden layers, such as 64 64; default: the recipe's."""
    progress: bool = True
    """Show a progress bar."""
    checkpoint_seconds: Annotated[float, Field(ge=0, le=86_400)] = 60.0
    """Time between two checkpoints [s]."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER|model.zip")] = None
    """Folder of a training that was killed, to go on where its newest checkpoint is; or a model.zip
    to train on in a new training, with the hyperparameters in it. Needs --trust."""
    trust: bool = False
    """Allow the zips of --resume to run code in them: only for zips from people you trust."""

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        """Check the algorithm and the device, and what only several seeds have."""
        find_algorithm(self.algo)
        if self.device not in TORCH_DEVICES:
            near = suggest_name(self.device, TORCH_DEVICES)
            raise ConfigError(f"--device {self.device}: unknown{near}")
        if self.seeds is None and (self.workers, self.address) != (None, None):
            raise ConfigError("--workers and --address: train several seeds: give --seeds, too")
        return self


def require_training() -> None:
    """Check that what training needs is installed."""
    with require_extra("training", "train"):
        for module in ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript"):
            if find_spec(module) is None:
                raise ModuleNotFoundError(module)


@dataclass(frozen=True)
class TrainingPlan:
    """A training."""

    options: TrainingOptions
    env_id: str
    algorithm: Algorithm
    recipe: Recipe
    episode_steps: int
    """Time limit of an episode [steps]."""
    threads: int
    out: Path
    robot: RobotConfig
    """The first one where a fleet is trained."""

    @classmethod
    def of(cls, options: TrainingOptions) -> TrainingPlan:
        """Derive the settings of a training; writes nothing."""
        env_id = ids.find_id(options.env)
        own = ids.strip_module(env_id)
        limit = gymnasium.spec(own).max_episode_steps
        if limit is None:
            raise ConfigError(f"env {options.env}: has no max_episode_steps, training needs one")
        if options.worlds and own == "acsar_gym/PointGoal-v0":
            raise ConfigError("--worlds: point_goal has none")
        if options.threads is None:
            threads = measure_free_cores()
        else:
            threads = check_threads("--threads", options.threads)
        robot, kind = make_fleet(options.robot, 1).robots[0], find_algorithm(options.algo)
        short = options.env if "/" not in options.env else own.rpartition("/")[2]
        out = options.out or Path("runs") / short
        modules = [*options.modules, *filter(None, [env_id.rpartition(":")[0]])]
        recipe = recipes.read_recipe(
            kind, own, options.conf_file, modules, options.conf_entry
        ).with_changes(
            steps=options.steps,
            robots=options.robots,
            gamma=options.gamma,
            learning_rate=options.learning_rate,
            net=options.net,
        )
        return cls(options, env_id, kind, recipe, limit, threads, out, robot)

    @property
    def varied(self) -> Any:
        """What every episode of the training draws anew: the recipe's ranges if it has any."""
        ranges = self.recipe.env_kwargs.get(RANDOMIZATION_KEY)
        return self.options.randomize and (True if ranges is None else ranges)

    @property
    def randomization(self) -> Randomization:
        """The same for the first robot."""
        return Randomization.of(self.varied, self.robot)

    @property
    def held_out_robot(self) -> str | None:
        """The robots that are evaluated: others than those of the training where they are drawn."""
        asked = self.options.robot
        return "drawn:validation" if drawn.PREFIX in (asked or "") else asked

    @property
    def evaluations(self) -> int:
        """Held-out evaluations during the training, at most."""
        most = MAX_EVALUATIONS * (1 if self.options.target is None else TARGET_EVALUATIONS)
        return max(1, min(most, self.recipe.steps // MIN_STEPS_BETWEEN))

    @property
    def update_hint(self) -> str:
        """How few updates there will be, and which --robots gives more; empty for enough."""
        steps, robots = self.recipe.steps, self.recipe.robots
        each = self.recipe.steps_per_update(self.algorithm)
        if each is None or (updates := math.ceil(steps / (each * robots))) >= FEW_UPDATES:
            return ""
        fewer = max(1, steps // (each * 2 * FEW_UPDATES))
        more = math.ceil(steps / (each * fewer))
        if more <= updates:
            return ""
        return (
            f"{steps:,} steps of {robots} robots are {updates} update{'s' * (updates > 1)} of the "
            f"policy, few to learn from: with --robots {fewer} there are {more}"
        )

    def make_training_batch(self) -> RobotVectorEnv:
        """Make the batch of robots to train on."""
        robots = self.recipe.robots
        return ids.make_vec(
            self.env_id,
            robots,
            robot=self.options.robot,
            autoreset_mode="SameStep",
            threads=max(1, min(self.threads, robots // ROBOTS_PER_THREAD)),
            randomization=self.varied,
            **self._arguments,
        )

    def make_held_out_batch(self, learning: RobotVectorEnv) -> RobotVectorEnv:
        """Make the batch to evaluate on: no randomization, and worlds that aren't trained in."""
        few = self.options.target is None
        robots = held_out.HELD_OUT_ROBOTS if few else held_out.TARGET_ROBOTS
        arguments = self._arguments
        beside = held_out.choose_held_out_worlds(learning.pool, robots)
        if beside is not None:
            arguments["worlds"] = beside
        count = 1 if few else max(1, min(self.threads, robots // ROBOTS_PER_THREAD))
        robot = self.held_out_robot
        return ids.make_vec(self.env_id, robots, robot=robot, threads=count, **arguments)

    @property
    def _arguments(self) -> dict[str, Any]:
        """Arguments of the env: the recipe's, and the worlds if the user gave some."""
        options = self.options
        worlds = place_worlds(options.worlds, options.start, options.goal)
        given = {
            key: each for key, each in self.recipe.env_kwargs.items() if key != RANDOMIZATION_KEY
        }
        return given | ({} if worlds is None else {"worlds": worlds})

    def __str__(self) -> str:
        cores = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        found = self.options.randomize and randomization.describe_ranges(self.robot)
        return f"{cores}, seed {self.options.seed}" + (f"; {found}" if found else "")


def wait_passively() -> None:
    """Make OpenMP threads sleep while they wait, unless OMP_WAIT_POLICY is already set.

    torch's threads busy-wait for each other after every small operation. If one of them shares its
    core with another program, all others wait for it, and two threads are many times slower than
    one. Call this before torch is imported; libraries that are already loaded aren't affected.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def measure_free_cores() -> int:
    """Measure how many cores other programs leave free, at least 1; takes PROBE_TIME seconds."""
    with require_extra("training", "train"):
        import psutil  # noqa: PLC0415 - optional
    idle = psutil.cpu_times_percent(interval=PROBE_TIME).idle / 100.0
    return max(1, min(usable_cores(), round(idle * (psutil.cpu_count() or 1))))

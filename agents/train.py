"""Train PPO on thousands of planar robots and export the actor as one ONNX file.

    python agents/train.py --env obstacle_goal --out runs/obstacle_goal
    python agents/train.py --env mine.module:mine/Clearance-v0 --steps 2000000

writes policy.onnx (to drive with), model.zip (to continue training), checkpoints and TensorBoard
logs into the folder. --resume model.zip --trust continues a training. Ctrl-C and SIGTERM end it
early, and save the model. The success rate on held-out robots, in worlds that aren't trained in, is
logged as eval/success_rate; with --worlds FILE or FOLDER there are no other worlds, so it is
measured in the same ones, with other seeds.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics import Randomization, measured
from acsar_gym.envs import ids
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    PolicyError,
    printable,
)
from acsar_gym.policies import ZipPolicy
from acsar_gym.policies.describing import described
from acsar_gym.training import held_out, threads
from acsar_gym.training.options import Options
from acsar_gym.training.signals import StopRequest
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.settings import FAIR_SHARE

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.training import callbacks

MOST_TORCH_THREADS = 2
"""Default limit of torch's threads; more don't help with networks this small."""


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters for one env; the defaults are for envs of other packages."""

    steps: int = 1_000_000
    net: tuple[int, ...] = (64, 64)
    gamma: float = 0.98
    rollout_steps: int = 64
    batch_size: int = 4096
    epochs: int = 6
    learning_rate: float = 1e-3
    evaluations: int = 16
    """Held-out evaluations during the training; they take 3 to 5 % of the time."""


RECIPES = {
    "acsar_gym/PointGoal-v0": Recipe(600_000, evaluations=6),
    "acsar_gym/PathFollow-v0": Recipe(1_000_000, evaluations=3),
    "acsar_gym/ObstacleGoal-v1": Recipe(
        6_000_000,
        net=(128, 128),
        gamma=0.99,
        batch_size=8192,
        epochs=5,
        learning_rate=7e-4,
    ),
    "acsar_gym/Barn-v1": Recipe(
        15_000_000,
        net=(256, 128),
        gamma=0.99,
        batch_size=8192,
        epochs=5,
        learning_rate=5e-4,
    ),
}
"""Hyperparameters by env. All train in the training split; the first worlds are the test split."""


@dataclass(frozen=True)
class Plan:
    """A training: the user's options, and the settings that follow from them."""

    options: Options
    env_id: str
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
            ConfigError: the env isn't registered, has no time limit or no worlds, or the folder
                or the number of threads can't be used.
        """
        env_id = ids.registered(options.env)
        own = ids.without_module(env_id)
        limit = gymnasium.spec(own).max_episode_steps
        if limit is None:
            raise ConfigError(f"env {options.env}: has no max_episode_steps, training needs one")
        if options.worlds is not None and own == "acsar_gym/PointGoal-v0":
            raise ConfigError("--worlds: point_goal has none")
        named = {
            name: getattr(options, name) for name in ("steps", "gamma", "learning_rate", "net")
        }
        chosen = {name: value for name, value in named.items() if value is not None}
        recipe = replace(RECIPES.get(own, Recipe()), **chosen)
        count = threads.chosen(options.threads)
        robot = RobotConfig.of(options.robot)
        return cls(options, env_id, recipe, limit, count, _folder(options, own), robot)

    @property
    def worlds(self) -> dict[str, Any]:
        """The `worlds` argument of the env, if the user gave one."""
        return {} if self.options.worlds is None else {"worlds": self.options.worlds}

    @property
    def randomization(self) -> Randomization:
        """What every episode of the training draws anew."""
        return Randomization.measured(self.robot) if self.options.randomize else Randomization()

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


def train(options: Options) -> int:
    """Train, save, export, and print the success rate.

    Args:
        options: the user's options.

    Returns:
        Exit code: 130 if Ctrl-C ended the training early, 143 if SIGTERM did, else 0.
    """
    options.check()
    threads.wait_passively()
    with StopRequest() as stop, contextlib.ExitStack() as batches:
        plan = Plan.of(options)
        saved = ZipPolicy(options.resume, trust=options.trust) if options.resume else None
        env = batches.enter_context(contextlib.closing(_learning(plan)))
        apart = batches.enter_context(contextlib.closing(_held_out(plan, env)))
        print(printable(f"{held_out.told(env, apart)}; {plan}"), flush=True)
        _learn(plan, _model(plan, env, saved), (env, apart), stop)
        return stop.exit_code


def _learning(plan: Plan) -> RobotVectorEnv:
    """Make the batch of robots to train on."""
    options = plan.options
    return ids.make_vec(
        plan.env_id,
        options.robots,
        robot=options.robot,
        autoreset_mode="SameStep",
        threads=max(1, min(plan.threads, options.robots // FAIR_SHARE)),
        randomization=plan.randomization,
        **plan.worlds,
    )


def _held_out(plan: Plan, learning: RobotVectorEnv) -> RobotVectorEnv:
    """Make the batch to evaluate on: no randomization, and worlds that aren't trained in."""
    beside = held_out.worlds_beside(learning.pool)
    worlds = plan.worlds if beside is None else {"worlds": beside}
    return ids.make_vec(plan.env_id, held_out.ROBOTS, robot=plan.options.robot, threads=1, **worlds)


def _model(plan: Plan, env: RobotVectorEnv, saved: ZipPolicy | None) -> PPO:
    """Make a new PPO model, or load the one to resume."""
    import torch  # noqa: PLC0415
    from stable_baselines3 import PPO  # noqa: PLC0415

    from acsar_gym.policies import sb3  # noqa: PLC0415

    options, recipe, logs = plan.options, plan.recipe, str(plan.out / "tensorboard")
    torch.set_num_threads(min(plan.threads, options.threads or MOST_TORCH_THREADS))
    always: dict[str, Any] = {"device": "cpu", "seed": options.seed, "tensorboard_log": logs}
    batch = sb3.BatchVecEnv(env)
    if saved is not None:
        _check_resumable(saved, env)
        model = PPO.load(saved.path, batch, **always)
    else:
        model = PPO(
            "MlpPolicy",
            batch,
            n_steps=recipe.rollout_steps,
            batch_size=min(recipe.batch_size, recipe.rollout_steps * options.robots),
            n_epochs=recipe.epochs,
            learning_rate=recipe.learning_rate,
            gamma=recipe.gamma,
            gae_lambda=0.95,
            ent_coef=0.0,
            policy_kwargs={"net_arch": list(recipe.net), "log_std_init": -0.5},
            stats_window_size=options.robots,
            **always,
        )
    return model


def _check_resumable(saved: ZipPolicy, env: RobotVectorEnv) -> None:
    """Check that a zip is a PPO model for the same observation."""
    from stable_baselines3.common.policies import ActorCriticPolicy  # noqa: PLC0415

    saved.check(env.task, env.sensors)
    if not isinstance(saved.network, ActorCriticPolicy):
        raise PolicyError(f"{saved.path}: only PPO's models can be trained on")


def _learn(
    plan: Plan, model: PPO, batches: tuple[RobotVectorEnv, RobotVectorEnv], stop: StopRequest
) -> None:
    """Train, save the model, and print its score unless a signal ended the training."""
    from acsar_gym.training import callbacks, saving  # noqa: PLC0415

    (env, apart), began = batches, time.monotonic()
    scores = callbacks.HeldOut(apart, plan.recipe.steps, plan.recipe.evaluations)
    watching = _callbacks(plan, scores, stop)
    fresh = plan.options.resume is None
    try:
        model.learn(plan.recipe.steps, callback=watching, reset_num_timesteps=fresh)
    finally:
        for each in watching:  # restores the terminal in any case; idempotent
            each.on_training_end()
    if stop.number is not None:
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
    score = scores.score if stop.number is not None else scores.finish()
    bundle = described(
        env,
        plan.env_id,
        randomization=plan.randomization,
        training=saving.told(model, asdict(plan.recipe), time.monotonic() - began),
        metrics={} if score is None else {"held_out": asdict(score)},
    )
    policy, zipped = saving.save(model, bundle, plan.out)
    print(printable(f"written: {policy} (to drive with), {zipped} (to train on)"))
    if stop.number is None and score is not None:
        _tell(plan, score, scores.name, policy)


def _callbacks(plan: Plan, scores: callbacks.HeldOut, stop: StopRequest) -> list[BaseCallback]:
    """Make the callbacks of the training."""
    from stable_baselines3.common.callbacks import CheckpointCallback  # noqa: PLC0415

    from acsar_gym.training import callbacks  # noqa: PLC0415

    recipe = plan.recipe
    checkpoints = CheckpointCallback(
        save_freq=max(recipe.steps // (4 * plan.options.robots), recipe.rollout_steps),
        save_path=str(plan.out / "checkpoints"),
    )
    cohorts = callbacks.WholeCohorts(plan.episode_steps)
    watching: list[BaseCallback] = [callbacks.EndOnSignal(stop), cohorts, scores, checkpoints]
    if plan.options.progress:
        watching.append(callbacks.TrainingProgress(recipe.steps, scores))
    return watching


def _tell(plan: Plan, score: held_out.Score, name: str, policy: Path) -> None:
    """Print the score and the next command."""
    wins = round(score.success_rate * score.episodes)
    print(f"{name}: {wins} of {score.episodes} episodes ({score.success_rate:.1%})")
    env = "" if plan.env_id.startswith("acsar_gym/") else f" --env {plan.env_id}"
    robot = f" --robot {plan.options.robot}" if plan.options.robot else ""
    print(printable(f"next: acsar-gym evaluate --policy {policy}{env}{robot}"))


def main(arguments: Sequence[str]) -> int:
    """Train with the options of a command line; returns the exit code."""
    return train(tyro.cli(Options, prog="acsar-gym train", args=list(arguments)))


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except AcsarError as error:
        print(f"acsar-gym train: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)

"""Train PPO on thousands of planar robots and export the actor as one ONNX file.

    python agents/train.py --env obstacle_goal --out runs/obstacle_goal

writes policy.onnx (what drives the robot), model.zip (to train on), checkpoints and TensorBoard
logs into the folder. --resume model.zip --trust trains one of those zips on. Ctrl-C and SIGTERM end
it early, and save what there is. How good the policy is, on robots that don't train and in worlds
that aren't trained in, is logged as eval/success_rate; with --worlds FILE or FOLDER there are no
others, so it's measured in the same worlds, from other seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from acsar_gym import envs
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    MissingExtraError,
    PolicyError,
    printable,
    shown,
)
from acsar_gym.policies import ZipPolicy
from acsar_gym.training import held_out, threads
from acsar_gym.training.signals import StopRequest
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.settings import FAIR_SHARE

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

MOST_STEPS = 10**10
MOST_ROBOTS = 16_384
"""A rollout of so many takes 0.2 to 1 GB."""
MOST_TORCH_THREADS = 2
"""More, where --threads doesn't ask for them, aren't worth it for nets as small as these."""
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
    evaluations: int = 16
    """How often held-out robots are evaluated in between; that takes 3 to 5 % of the time."""
    options: dict[str, Any] = field(default_factory=dict)
    """Arguments of the env."""


RECIPES = {
    "point_goal": Recipe(envs.PointGoalVectorEnv, 600_000, 200, evaluations=6),
    "path_follow": Recipe(
        envs.PathFollowVectorEnv,
        1_000_000,
        400,
        evaluations=3,
        options={"worlds": "smooth_path:train"},
    ),
    "obstacle_goal": Recipe(
        envs.ObstacleGoalVectorEnv,
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
        envs.BarnVectorEnv,
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
"""Worlds to train in begin at number 1000: the first ones are left to be evaluated in."""


@dataclass(frozen=True)
class Options:
    """PPO on one of the environments."""

    env: Literal["point_goal", "path_follow", "obstacle_goal", "barn"] = "point_goal"
    """What to learn; each has its own hyperparameters (see RECIPES)."""
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
    """Train, save, export, and say how good it is.

    Returns:
        The exit code: 130 where Ctrl-C ended the training early, 143 where SIGTERM did.
    """
    _check(options)
    threads.wait_passively()
    with StopRequest() as stop:
        recipe, out = RECIPES[options.env], _folder(options)
        count = threads.chosen(options.threads)
        saved = ZipPolicy(options.resume, trust=options.trust) if options.resume else None
        env, apart = _env(recipe, options, count), _held_out(recipe, options)
        try:
            _begin(env, apart, options, count)
            model = _model(recipe, env, options, saved, out / "tensorboard", count)
            _learn(model, recipe, options, apart, stop, out)
        finally:
            env.close()
            apart.close()
        return stop.exit_code


def _check(options: Options) -> None:
    """Whatever can be known to be wrong before anything is started."""
    ranges = (
        ("steps", options.steps, 1, MOST_STEPS),
        ("robots", options.robots, 1, MOST_ROBOTS),
        ("seed", options.seed, 0, held_out.FIRST_SEED - 1),
    )
    for name, value, least, most in ranges:
        if value is not None and not least <= value <= most:
            raise ConfigError(f"--{name} {shown(value)}: must be {least:,} to {most:,}")
    if options.env == "point_goal" and options.worlds is not None:
        raise ConfigError("--worlds: point_goal has none")
    for module in ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript"):
        try:
            missing = find_spec(module) is None
        except ImportError:
            missing = True
        if missing:
            raise MissingExtraError("training", "train")


def _folder(options: Options) -> Path:
    out = options.out or Path("runs") / options.env
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: can't be written: {error.strerror}") from None
    return out


def _env(recipe: Recipe, options: Options, count: int) -> RobotVectorEnv:
    """The robots that learn."""
    return recipe.env(
        options.robots,
        options.robot,
        max_episode_steps=recipe.episode_steps,
        autoreset_mode="SameStep",
        threads=max(1, min(count, options.robots // FAIR_SHARE)),
        randomization=RANDOMIZATION if options.randomize else None,
        **_arguments(recipe, options),
    )


def _held_out(recipe: Recipe, options: Options) -> RobotVectorEnv:
    """Robots that tell how good the policy is: as configured, in worlds that aren't trained in."""
    arguments = _arguments(recipe, options)
    if "worlds" in arguments:
        arguments["worlds"] = held_out.worlds_beside(arguments["worlds"])
    steps = recipe.episode_steps
    return recipe.env(
        held_out.ROBOTS, options.robot, max_episode_steps=steps, threads=1, **arguments
    )


def _arguments(recipe: Recipe, options: Options) -> dict[str, Any]:
    chosen = {} if options.worlds is None else {"worlds": options.worlds}
    return recipe.options | chosen


def _begin(env: RobotVectorEnv, apart: RobotVectorEnv, options: Options, count: int) -> None:
    """Say what is trained in, evaluated in, and with."""
    cores = "1 thread" if count == 1 else f"{count} threads"
    print(printable(f"{held_out.told(env, apart)}; {cores}, seed {options.seed}"), flush=True)


def _model(
    recipe: Recipe,
    env: RobotVectorEnv,
    options: Options,
    saved: ZipPolicy | None,
    logs: Path,
    count: int,
) -> PPO:
    import torch  # noqa: PLC0415
    from stable_baselines3 import PPO  # noqa: PLC0415

    from acsar_gym.policies import sb3  # noqa: PLC0415

    torch.set_num_threads(min(count, options.threads or MOST_TORCH_THREADS))
    always: dict[str, Any] = {"device": "cpu", "seed": options.seed, "tensorboard_log": str(logs)}
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
    sb3.label(model, env.task, env.sensors)
    return model


def _check_resumable(saved: ZipPolicy, env: RobotVectorEnv) -> None:
    from stable_baselines3.common.policies import ActorCriticPolicy  # noqa: PLC0415

    saved.check(env.task, env.sensors)
    if not isinstance(saved.network, ActorCriticPolicy):
        raise PolicyError(f"{saved.path}: only PPO's models can be trained on")


def _learn(
    model: PPO,
    recipe: Recipe,
    options: Options,
    apart: RobotVectorEnv,
    stop: StopRequest,
    out: Path,
) -> None:
    from stable_baselines3.common.callbacks import CheckpointCallback  # noqa: PLC0415

    from acsar_gym.training import callbacks  # noqa: PLC0415

    steps = options.steps or recipe.steps
    scores = callbacks.HeldOut(apart, steps, recipe.evaluations)
    checkpoints = CheckpointCallback(
        save_freq=max(steps // (4 * options.robots), recipe.rollout_steps),
        save_path=str(out / "checkpoints"),
    )
    watching: list[BaseCallback] = [
        callbacks.EndOnSignal(stop),
        callbacks.WholeCohorts(recipe.episode_steps),
        scores,
        checkpoints,
    ]
    if options.progress:
        watching.append(callbacks.TrainingProgress(steps, scores))
    try:
        model.learn(steps, callback=watching, reset_num_timesteps=options.resume is None)
    finally:
        for each in watching:  # gives the terminal back, however it ended; twice is once
            each.on_training_end()
    if stop.number is not None:
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
    _save(model, apart, out)
    if stop.number is None:
        _tell(scores.finish(), scores.name, options, out)


def _save(model: PPO, env: RobotVectorEnv, out: Path) -> None:
    from acsar_gym.policies import sb3_export  # noqa: PLC0415

    _replace(out / "model.zip", model.save)
    _replace(
        out / "policy.onnx",
        lambda path: sb3_export.export(model.policy, path, env.task, env.sensors),
    )
    files = f"{out / 'policy.onnx'} (to drive with), {out / 'model.zip'} (to train on)"
    print(printable(f"written: {files}"))


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all: what was there before stays until then."""
    new = path.with_name(f".{path.name}")
    try:
        write(new)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def _tell(score: held_out.Score, name: str, options: Options, out: Path) -> None:
    """How good the policy is, and what to do next."""
    wins = round(score.success_rate * score.episodes)
    print(f"{name}: {wins} of {score.episodes} episodes ({score.success_rate:.1%})")
    robot = f" --robot {options.robot}" if options.robot else ""
    print(printable(f"next: acsar-gym evaluate --policy {out / 'policy.onnx'}{robot}"))


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

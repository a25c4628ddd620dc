"""Runs a training: batches, model, callbacks, and what it leaves in its folder. Imports torch."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from acsar_gym import reading
from acsar_gym.envs import ids
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    PolicyError,
    check_extra,
    escape_unprintable,
    explain_error,
    format_error,
)
from acsar_gym.tools.policies.document import PolicyDocument, describe_policy
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED, TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.recipes import load_algorithm
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.tools.training.callbacks import HeldOutScores, Score

MAX_TORCH_THREADS = 2
"""Default limit of torch's threads. More don't help with networks this small."""


@dataclass(frozen=True)
class TrainingResult:
    """The folder of a training, and what it achieved."""

    out: Path
    steps: int
    seconds: float
    score: Score | None
    """Of the held-out episodes after the training."""


def train(options: TrainingOptions) -> TrainingResult:
    """Train a policy, save model and policy, and print the held-out score.

    Ctrl-C and SIGTERM raise KeyboardInterrupt, after model and policy were saved.

    Raises:
        AcsarError: An option, recipe or folder can't be used, or the folder can't be written.
    """
    require_training()
    wait_passively()

    # What can be wrong is checked before anything is made.
    start = options.resume
    is_resumed = start is not None and start.is_dir()
    if start is not None and is_resumed:
        options, start = folders.resume_options(options, start)
    elif options.out is not None:
        folders.check_empty(options.out)
    plan = TrainingPlan.of(options)

    with sigterm_interrupts(), contextlib.ExitStack() as stack:
        # Batches: one to learn in, and one with worlds that the training never sees.
        env = stack.enter_context(contextlib.closing(plan.make_training_batch()))
        held_out_env = stack.enter_context(contextlib.closing(plan.make_held_out_batch(env)))
        for line in plan.describe(env, held_out_env):
            print(escape_unprintable(line), flush=True)

        # Folder and model: new, or those of the training that goes on.
        if is_resumed:
            out = options.out or Path()
        else:
            out = folders.make_folder(options.out, options.env.rpartition("/")[2])
        model = make_model(plan, env, out, start)
        if is_resumed:
            done = f"{model.num_timesteps:,} of {plan.recipe.steps:,} steps"
            print(f"going on at {done}, with new episodes", flush=True)
        else:
            model.num_timesteps = 0
            key = ids.strip_module(plan.env_id)
            folders.begin_config(out, key, plan.recipe.values, options)

        with explain_disk_errors(out):
            return _learn_and_save(plan, model, env, held_out_env, out)


def _learn_and_save(
    plan: TrainingPlan,
    model: BaseAlgorithm,
    env: RobotVectorEnv,
    held_out_env: RobotVectorEnv,
    out: Path,
) -> TrainingResult:
    """Train until all steps are done, the target is reached, or an interrupt, and save."""
    from acsar_gym.tools.policies import sb3_export  # noqa: PLC0415 - imports torch
    from acsar_gym.tools.training import callbacks  # noqa: PLC0415

    # Without a terminal the bar is only a clock, and lines are printed instead.
    options = plan.options
    scores = callbacks.HeldOutScores(held_out_env, out, plan.evaluation_interval, options.target)
    bar = Progress(BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    bar.disable = not (options.progress and bar.console.is_terminal)
    watching: list[BaseCallback] = [
        callbacks.CheckpointWriter(out, options.checkpoint_seconds),
        callbacks.WholeCohorts(plan.episode_steps),
        scores,
    ]
    if options.progress:
        watching.append(callbacks.TrainingProgress(bar, plan.recipe.steps, scores))

    # Checkpoints contain the label as well: a policy can be made of each.
    sb3_export.label(model, describe_model(plan, model, env))
    interrupt = None
    try:
        with bar, contextlib.suppress(callbacks.TargetReached):
            steps = plan.recipe.steps - model.num_timesteps
            model.learn(steps, callback=watching, reset_num_timesteps=model.num_timesteps == 0)
        scores.finish()
    except KeyboardInterrupt as error:
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is", flush=True)
        interrupt = error

    # The model first: the policy can be made of it again.
    document = describe_model(plan, model, env, scores)
    sb3_export.label(model, document)
    folders.write_model(model, out / folders.MODEL_FILE)
    policy = sb3_export.export_policy(model.policy, document)
    with reading.replace_file(out / folders.POLICY_FILE) as new:
        new.write_bytes(policy)
    callbacks.draw_curve(out, scores.curve, f"{options.algo} on {plan.env_id}, seed {options.seed}")
    print_results(plan, scores, out, is_finished=interrupt is None)
    if interrupt is not None:
        raise interrupt
    return TrainingResult(out, model.num_timesteps, scores.seconds, scores.score)


def make_model(
    plan: TrainingPlan, env: RobotVectorEnv, out: Path, start: Path | None = None
) -> BaseAlgorithm:
    """Make a new model by the recipe, or load the model `start`, which can run code."""
    import torch  # noqa: PLC0415 - optional, slow

    from acsar_gym.tools.policies.sb3 import BatchVecEnv  # noqa: PLC0415

    # Errors that are known before the model is loaded.
    options = plan.options
    torch.set_num_threads(min(plan.threads, options.threads or MAX_TORCH_THREADS))
    if options.device == "cuda" and not torch.cuda.is_available():
        cause = "has no CUDA device that it can use" if torch.version.cuda else "is without CUDA"
        raise ConfigError(f"--device cuda: torch {torch.__version__} {cause}: leave --device out")
    if start is not None and not options.trust:
        raise PolicyError(
            f"{start}: a stable-baselines3 zip can run any code when it's loaded: pass --trust if "
            "you made it or trust its author"
        )

    # A training that goes on doesn't repeat the episodes of its start.
    algorithm: Any = load_algorithm(options.algo)
    batch = plan.recipe.wrap_batch(BatchVecEnv(env))
    seed = options.seed + (folders.count_steps(start) if start else 0)
    arguments = {
        "device": options.device,
        "seed": seed % FIRST_HELD_OUT_SEED,
        "tensorboard_log": str(out / "tensorboard"),
    }
    try:
        if start is None:
            built = {"stats_window_size": env.num_envs, **plan.recipe.build_arguments()}
            model = algorithm(env=batch, **built | arguments)
        else:
            model = algorithm.load(start, batch, **arguments)
            if (start.parent / folders.BUFFER_FILE).exists():
                model.load_replay_buffer(start.parent / folders.BUFFER_FILE)
    except AcsarError:
        raise
    except Exception as error:
        problem = f"{start}: isn't a model of {algorithm.__name__} for this env"
        kind = PolicyError if start else ConfigError
        raise kind(f"{problem if start else plan.recipe.place}: {format_error(error)}") from error
    checked: BaseAlgorithm = model
    return checked


def describe_model(
    plan: TrainingPlan,
    model: BaseAlgorithm,
    env: RobotVectorEnv,
    scores: HeldOutScores | None = None,
) -> PolicyDocument:
    """Describe the policy of a model and its training."""
    space: Any = model.observation_space
    training = {
        "algorithm": type(model).__name__,
        "recipe": plan.recipe.values,
        "steps": model.num_timesteps,
        "seed": plan.options.seed,
        **folders.describe_origin(plan.options),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }

    # An interrupt can come before the first evaluation.
    if scores is not None and scores.score is not None:
        training |= {
            "seconds": round(scores.seconds, 1),
            "held_out": {"episodes": scores.batch.num_envs, **scores.score._asdict()},
        }
    return describe_policy(
        env,
        plan.env_id,
        width=space.shape[0],
        randomization=plan.randomization,
        training=training,
    )


def print_results(
    plan: TrainingPlan, scores: HeldOutScores, out: Path, *, is_finished: bool
) -> None:
    """Print what was written, and how good the policy is."""
    policy = out / folders.POLICY_FILE
    lines = [f"written: {policy} (to drive with), {out / folders.MODEL_FILE} (to train on)"]
    options = plan.options
    if is_finished and (score := scores.score):
        count = scores.batch.num_envs
        wins = f"{round(score.success_rate * count)} of {count} episodes"
        lines.append(f"held-out success: {wins} ({score.success_rate:.1%})")
        if options.target is not None:
            result = "reached" if scores.is_reached else "not reached"
            lines[-1] += f"; target of {options.target:.1%} {result} at {score.steps:,} steps"

        words = ["acsar-gym", "evaluate", "--policy", str(policy)]
        if not plan.env_id.startswith("acsar_gym/"):
            words += ["--env", plan.env_id]
        if options.robot and len(plan.robots) == 1:
            words += ["--robot", options.robot]
        lines.append(f"next: {shlex.join(words)}")
    for line in lines:
        print(escape_unprintable(line), flush=True)


def require_training() -> None:
    """Check that what training needs is installed."""
    modules = ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript")
    check_extra("training", "train", *modules)


def wait_passively() -> None:
    """Make OpenMP threads sleep while they wait, unless OMP_WAIT_POLICY is already set.

    torch's threads busy-wait for each other after every small operation. If one of them shares its
    core with another program, all others wait for it, and two threads are many times slower than
    one. Call this before torch is imported: libraries that are already loaded aren't affected.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt("SIGTERM"), as Ctrl-C does, in the main thread."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt("SIGTERM")

    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ValueError):  # another thread
            handler = signal.signal(signal.SIGTERM, interrupt)
            stack.callback(signal.signal, signal.SIGTERM, handler)
        yield


@contextlib.contextmanager
def explain_disk_errors(out: Path) -> Iterator[None]:
    """Turn the errors of a full or broken disk into a line with what to do."""
    try:
        yield
    except OSError as error:
        raise AcsarError(
            f"--out {out}: can't be written: {explain_error(error)}: make room, then go on with "
            f"--resume {shlex.quote(str(out))} --trust"
        ) from error

"""Runs a training: batches, model, callbacks, and what it leaves in its folder."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from acsar_gym.tools.evaluation import provenance
from acsar_gym.tools.evaluation.metrics import Summary
from acsar_gym.tools.policies.document import PolicyDocument, describe_policy
from acsar_gym.tools.training import folders, held_out
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED, TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.recipes import load_algorithm
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.tools.training.callbacks import HeldOutScores

MAX_TORCH_THREADS = 2
"""Default limit of torch's threads; more don't help with networks this small."""


@dataclass(frozen=True)
class TrainingResult:
    """What a training came to."""

    out: Path
    steps: int
    seconds: float
    score: Summary | None
    """Of the held-out episodes after the training."""


def train(options: TrainingOptions) -> TrainingResult:
    """Train a policy, save model and policy, and print the held-out score.

    Ctrl-C and SIGTERM raise KeyboardInterrupt, after what there is was saved.

    Raises:
        AcsarError: An option, recipe or folder can't be used, or the folder can't be written.
    """
    started = time.monotonic()
    require_training()
    wait_passively()
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
        for line in plan.describe(held_out.describe_worlds(env, held_out_env)):
            print(escape_unprintable(line), flush=True)

        # Folder and model: new, or those of the training that goes on.
        if is_resumed:
            out = options.out or Path()
        else:
            out = folders.make_folder(options.out, plan.short_name)
        model = make_model(plan, env, out) if start is None else load_model(plan, env, out, start)
        if is_resumed:
            check_steps_left(plan, model, out)
        else:
            key = ids.strip_module(plan.env_id)
            folders.begin_config(out, key, plan.recipe.values, options)
            if start is not None:
                model.num_timesteps = 0

        with explain_disk_errors(out):
            return _learn_and_save(plan, model, env, held_out_env, out=out, started=started)


def _learn_and_save(
    plan: TrainingPlan,
    model: BaseAlgorithm,
    env: RobotVectorEnv,
    held_out_env: RobotVectorEnv,
    *,
    out: Path,
    started: float,
) -> TrainingResult:
    """Train, with a score and a checkpoint every so often, and save what there is at the end."""
    from acsar_gym.tools.policies import sb3_export  # noqa: PLC0415 - imports torch
    from acsar_gym.tools.training import callbacks  # noqa: PLC0415

    curve = held_out.Curve(out, model.num_timesteps)
    seconds_before = curve.rows[-1]["seconds"] if curve.rows else 0.0

    def clock() -> float:
        return time.monotonic() - started + seconds_before

    scores = callbacks.HeldOutScores(
        held_out_env, curve, plan.evaluation_interval, target=plan.options.target, clock=clock
    )
    sb3_export.label(model, describe_model(plan, model, env))
    interrupt = None
    try:
        _learn(plan, model, scores, out)
        scores.finish()
    except KeyboardInterrupt as error:
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is", flush=True)
        interrupt = error

    # The model first: the policy can be made of it again.
    document = describe_model(plan, model, env, scores.score, seconds=clock())
    sb3_export.label(model, document)
    folders.write_model(model, out / folders.MODEL_FILE)
    policy = sb3_export.export_policy(model.policy, document)
    with reading.replace_file(out / folders.POLICY_FILE) as new:
        new.write_bytes(policy)
    curve.draw(f"{plan.options.algo} on {plan.env_id}, seed {plan.options.seed}")
    print_results(plan, scores, out, is_finished=interrupt is None)
    if interrupt is not None:
        raise interrupt
    return TrainingResult(out, model.num_timesteps, clock(), scores.score)


def _learn(plan: TrainingPlan, model: BaseAlgorithm, scores: HeldOutScores, out: Path) -> None:
    """Train until all steps are done, the target is reached, or an interrupt."""
    from acsar_gym.tools.training import callbacks  # noqa: PLC0415

    watching: list[BaseCallback] = [
        callbacks.CheckpointWriter(out, plan.options.checkpoint_seconds),
        callbacks.WholeCohorts(plan.episode_steps),
        scores,
    ]
    if plan.options.progress:
        watching.append(callbacks.TrainingProgress(plan.recipe.steps, scores))
    try:
        with contextlib.suppress(callbacks.TargetReached):
            steps = plan.recipe.steps - model.num_timesteps
            model.learn(steps, callback=watching, reset_num_timesteps=model.num_timesteps == 0)
    finally:
        for callback in watching:  # restores the terminal in any case
            callback.on_training_end()


def make_model(plan: TrainingPlan, env: RobotVectorEnv, out: Path) -> BaseAlgorithm:
    """Make a new model by the recipe."""
    from acsar_gym.tools.policies.sb3 import BatchVecEnv  # noqa: PLC0415 - imports torch

    common = _prepare_torch(plan, out)
    arguments = {"stats_window_size": env.num_envs, **plan.recipe.build_arguments(), **common}
    batch = plan.recipe.wrap_batch(BatchVecEnv(env))
    try:
        return load_algorithm(plan.options.algo)(env=batch, **arguments)
    except AcsarError:
        raise
    except Exception as error:
        raise ConfigError(f"{plan.recipe.place}: {format_error(error)}") from error


def load_model(plan: TrainingPlan, env: RobotVectorEnv, out: Path, path: Path) -> BaseAlgorithm:
    """Load a model, and its replay buffer; both can run code."""
    from acsar_gym.tools.policies.sb3 import BatchVecEnv  # noqa: PLC0415 - imports torch

    if not plan.options.trust:
        raise PolicyError(
            f"{path}: a stable-baselines3 zip can run any code when it's loaded: pass --trust if "
            "you made it or trust its author"
        )
    common = _prepare_torch(plan, out)
    common["seed"] = (plan.options.seed + folders.count_steps(path)) % FIRST_HELD_OUT_SEED
    batch = plan.recipe.wrap_batch(BatchVecEnv(env))
    algorithm = load_algorithm(plan.options.algo)
    try:
        model = algorithm.load(path, batch, **common)
    except Exception as error:
        raise PolicyError(
            f"{path}: isn't a model of {algorithm.__name__} for this env: {format_error(error)}"
        ) from error
    buffer = path.with_name(folders.BUFFER_FILE)
    if getattr(model, "replay_buffer", None) is not None and buffer.exists():
        loader: Any = model
        loader.load_replay_buffer(buffer)
    return model


def _prepare_torch(plan: TrainingPlan, out: Path) -> dict[str, Any]:
    """Set torch's threads, check the device, and return what every model gets."""
    import torch  # noqa: PLC0415 - optional, slow

    torch.set_num_threads(min(plan.threads, plan.options.threads or MAX_TORCH_THREADS))
    if plan.options.device == "cuda" and not torch.cuda.is_available():
        cause = "has no CUDA device that it can use" if torch.version.cuda else "is without CUDA"
        raise ConfigError(f"--device cuda: torch {torch.__version__} {cause}: leave --device out")
    logs = str(out / "tensorboard")
    return {"device": plan.options.device, "seed": plan.options.seed, "tensorboard_log": logs}


def check_steps_left(plan: TrainingPlan, model: BaseAlgorithm, out: Path) -> None:
    """Raise ConfigError if a training that shall go on is done, and its policy is written."""
    is_done = model.num_timesteps >= plan.recipe.steps
    if is_done and (out / folders.POLICY_FILE).exists():
        raise ConfigError(
            f"{out}: its {plan.recipe.steps:,} steps are done: ask for more with --steps"
        )
    print(f"going on at {model.num_timesteps:,} steps, with new episodes", flush=True)


def describe_model(
    plan: TrainingPlan,
    model: BaseAlgorithm,
    env: RobotVectorEnv,
    score: Summary | None = None,
    *,
    seconds: float = 0.0,
) -> PolicyDocument:
    """Describe the policy of a model and its training."""
    space: Any = model.observation_space
    training = {
        "algorithm": type(model).__name__,
        "recipe": plan.recipe.values,
        "steps": model.num_timesteps,
        "seed": plan.options.seed,
        "command": folders.training_command(plan.options),
        "versions": provenance.library_versions(*folders.RECORDED_LIBRARIES),
        "revision": folders.git_revision(),
        "seconds": round(seconds, 1),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }

    if score is not None:
        training["held_out"] = {"episodes": score.episodes, **held_out.curve_figures(score)}
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
    score = scores.score
    if is_finished and score is not None:
        wins = round(score.success_rate * score.episodes)
        line = f"{scores.name}: {wins} of {score.episodes} episodes ({score.success_rate:.1%})"
        if plan.options.target is not None:
            result = "reached" if scores.is_reached else "not reached"
            steps = int(scores.curve.rows[-1]["steps"])
            line += f"; target of {plan.options.target:.1%} {result} at {steps:,} steps"

        words = ["acsar-gym", "evaluate", "--policy", str(policy)]
        if not plan.env_id.startswith("acsar_gym/"):
            words += ["--env", plan.env_id]
        if plan.options.robot and len(plan.robots) == 1:
            words += ["--robot", plan.options.robot]
        lines += [line, f"next: {shlex.join(words)}"]
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
    one. Call this before torch is imported; libraries that are already loaded aren't affected.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt("SIGTERM"), as Ctrl-C does; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt("SIGTERM")

    handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def explain_disk_errors(out: Path) -> Iterator[None]:
    """Turn the errors of a full or broken disk into a line with what to do."""
    try:
        yield
    except OSError as error:
        models = folders.find_models(out)
        newest = f"{models[0]} is whole" if models else "there is no model yet"
        resume = f", then go on with --resume {out} --trust" if models else ""
        reason = explain_error(error)
        raise AcsarError(
            f"--out {out}: can't be written: {reason}; {newest}: make room{resume}"
        ) from error

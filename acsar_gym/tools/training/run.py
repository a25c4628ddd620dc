"""Runs a training: batches, model, callbacks, and what it leaves in its folder. Imports torch."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.progress import Progress

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
from acsar_gym.tools.policies.document import (
    DOCUMENT_KEY,
    check_observation,
    describe_policy,
    parse_document,
)
from acsar_gym.tools.policies.zip_policy import check_trust
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED, TrainingOptions
from acsar_gym.tools.training.plan import Score, TrainingPlan
from acsar_gym.tools.training.recipes import load_algorithm
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

MAX_TORCH_THREADS = 2
"""Default limit of torch's threads. More don't help with networks this small."""


class TrainingResult(NamedTuple):
    """The folder of a training, and what it achieved."""

    out: Path
    score: Score
    """Of the held-out episodes after the training."""


def train(options: TrainingOptions) -> TrainingResult:
    """Train a policy, save model and policy, and print the held-out score.

    Ctrl-C and SIGTERM raise KeyboardInterrupt, after model and policy were saved. SIGTERM ends the
    program before the training has started.

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
    if start is not None:
        if not start.exists():
            raise ConfigError(f"--resume {start}: no such file or folder")
        check_trust(start, trust=options.trust)
    plan = TrainingPlan.of(options)

    # Batches: one to learn in, and one with worlds that the training never sees.
    with (
        contextlib.closing(plan.make_training_batch()) as env,
        contextlib.closing(plan.make_held_out_batch(env)) as held_out_env,
    ):
        for line in plan.describe(env, held_out_env):
            say(line)

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

        # Until here SIGTERM ends the program, as there is nothing to save.
        try:
            if is_resumed:
                folders.update_config(out, options)
            else:
                key = ids.strip_module(plan.env_id)
                folders.begin_config(out, key, plan.recipe.values, options)
            with sigterm_interrupts():
                return _learn_and_save(plan, model, env, held_out_env, out)
        except OSError as error:
            raise AcsarError(
                f"--out {out}: can't be written: {explain_error(error)}: make room, then go on "
                f"with --resume {shlex.quote(str(out))} --trust"
            ) from error


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

    # Checkpoints contain the label as well: a policy can be made of each.
    options = plan.options
    space: Any = model.observation_space
    training = {
        "algorithm": type(model).__name__,
        "recipe": plan.recipe.values,
        "seed": options.seed,
        **folders.describe_origin(options),
    }
    document = describe_policy(
        env,
        plan.env_id,
        width=space.shape[0],
        randomization=plan.randomization,
        training=training,
    )
    sb3_export.label(model, document)

    # On a terminal a bar, elsewhere only the lines of the scores.
    bar = Progress(disable=not (options.progress and sys.stdout.isatty()))
    watch = callbacks.TrainingWatch(plan, held_out_env, out, bar)
    interrupt = None
    try:
        with bar, contextlib.suppress(callbacks.TargetReached):
            steps = plan.recipe.steps - model.num_timesteps
            model.learn(steps, callback=watch, reset_num_timesteps=model.num_timesteps == 0)
        watch.finish()
    except KeyboardInterrupt as error:
        print(f"interrupted at {model.num_timesteps:,} steps: saving what there is", flush=True)
        interrupt = error

    # An interrupt can come before the first score.
    training = {**document.training, "steps": model.num_timesteps}
    if watch.score is not None:
        training["held_out"] = {"episodes": plan.held_out_robots, **watch.score._asdict()}
    document = document.model_copy(update={"training": training})
    sb3_export.label(model, document)

    # The model first: the policy can be made of it again.
    policy_file = out / folders.POLICY_FILE
    folders.write_model(model, out / folders.MODEL_FILE)
    policy = sb3_export.export_policy(model.policy, document)
    with reading.replace_file(policy_file) as new:
        new.write_bytes(policy)
    callbacks.draw_curve(out, watch.curve, f"{options.algo} on {plan.env_id}, seed {options.seed}")
    say(f"written: {policy_file} (to drive with), {out / folders.MODEL_FILE} (to train on)")
    if interrupt is not None:
        raise interrupt
    score = watch.curve[-1]
    print_score(plan, score, env, policy_file)
    return TrainingResult(out, score)


def make_model(
    plan: TrainingPlan, env: RobotVectorEnv, out: Path, start: Path | None = None
) -> BaseAlgorithm:
    """Make a new model by the recipe, or load the model `start`, which can run code."""
    import torch  # noqa: PLC0415 - optional, slow

    from acsar_gym.tools.policies.sb3 import BatchVecEnv  # noqa: PLC0415

    options = plan.options
    torch.set_num_threads(min(plan.threads, options.threads or MAX_TORCH_THREADS))
    # stable-baselines3 would train on the CPU without a word.
    if options.device == "cuda" and not torch.cuda.is_available():
        cause = "has no CUDA device that it can use" if torch.version.cuda else "is without CUDA"
        raise ConfigError(f"--device cuda: torch {torch.__version__} {cause}: leave --device out")
    if start is not None:
        check_start(start, env)

    # The recipe's wrappers may change what the policy observes.
    batch: VecEnv = BatchVecEnv(env)
    for wrapper in plan.recipe.import_wrappers():
        try:
            batch = wrapper(batch)
        except TypeError as error:
            problem = f"{plan.recipe.place}: vec_env_wrapper: {format_error(error)}"
            raise ConfigError(problem) from error

    # A training that goes on doesn't repeat the episodes of its start.
    seed = options.seed + (folders.count_steps(start) if start else 0)
    arguments = {
        "device": options.device,
        "seed": seed % FIRST_HELD_OUT_SEED,
        "tensorboard_log": str(out / "tensorboard"),
    }
    algorithm: Any = load_algorithm(options.algo)
    model: Any
    try:
        if start is None:
            recipe = {"stats_window_size": env.num_envs, **plan.recipe.build_arguments()}
            model = algorithm(env=batch, **recipe | arguments)
        else:
            model = algorithm.load(start, batch, **arguments)
            check_algorithm(start, model)
            # A new training may have another task, for which the transitions would be wrong.
            buffer = start.with_name(folders.BUFFER_FILE)
            if start.is_relative_to(out) and buffer.exists():
                model.load_replay_buffer(buffer)
    except AcsarError:
        raise
    except Exception as error:
        problem = plan.recipe.place
        if start is not None:
            problem = f"{start}: isn't a model of {algorithm.__name__} for this env"
        raise ConfigError(f"{problem}: {format_error(error)}") from error
    result: BaseAlgorithm = model
    return result


def check_start(start: Path, env: RobotVectorEnv) -> None:
    """Raise PolicyError if a model was trained on other observations. Others have no label."""
    label = folders.read_data(start).get(DOCUMENT_KEY)
    if label is None:
        return
    try:
        check_observation(parse_document({DOCUMENT_KEY: str(label)}), env.task, env.sensors)
    except PolicyError as error:
        raise PolicyError(f"{start}: {error}") from error


def check_algorithm(start: Path, model: BaseAlgorithm) -> None:
    """Raise PolicyError for a model of another algorithm, which may fail only when it learns."""
    # A policy of RecurrentPPO is also a policy of PPO.
    kind = type(model)
    is_of_kind = isinstance(model.policy, tuple(kind.policy_aliases.values()))
    needs_memory = kind.__name__ == "RecurrentPPO"
    if not is_of_kind or needs_memory != hasattr(model.policy, "lstm_actor"):
        name = type(model.policy).__name__
        raise PolicyError(
            f"{start}: contains a {name}, which {kind.__name__} can't train: choose its --algo"
        )


def print_score(plan: TrainingPlan, score: Score, env: RobotVectorEnv, policy: Path) -> None:
    """Print how good a policy is, and how to evaluate it."""
    options = plan.options
    count = plan.held_out_robots
    wins = f"{round(score.success_rate * count)} of {count} episodes"
    line = f"held-out success: {wins} ({score.success_rate:.1%})"
    if options.target is not None:
        result = "reached" if score.success_rate >= options.target else "not reached"
        line += f"; target of {options.target:.1%} {result} at {score.steps:,} steps"
    say(line)

    # What evaluate can't take from the policy.
    command = f"next: acsar-gym evaluate --policy {shlex.quote(str(policy))}"
    if not plan.env_id.startswith("acsar_gym/"):
        command += f" --env {plan.env_id}"
    if options.robot and len(set(env.fleet)) == 1:
        command += f" --robot {shlex.quote(options.robot)}"
    say(command)


def say(text: str) -> None:
    """Print a line at once, with control characters escaped."""
    print(escape_unprintable(text), flush=True)


def require_training() -> None:
    """Check that what training needs is installed."""
    modules = ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxscript", "matplotlib")
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

    # Only the main thread may set handlers, as in a job of Ray. A signal that is ignored stays so.
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is signal.SIG_IGN:
        yield
        return
    handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)

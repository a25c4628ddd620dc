"""Runs a training: batches, model, callbacks, and what is left of it in its folder."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from acsar_gym.errors import escape_unprintable
from acsar_gym.tools.policies import ZipPolicy
from acsar_gym.tools.policies.bundle import describe_policy
from acsar_gym.tools.training import checkpoints, held_out, record
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER, StopRequest, TrainingState
from acsar_gym.tools.training.plan import (
    TrainingOptions,
    TrainingPlan,
    require_training,
    wait_passively,
)

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.tools.training.callbacks import CheckpointWriter, HeldOutEvaluation

CURVE_NAME = "learning_curve"


def announce_training(plan: TrainingPlan, worlds: str) -> None:
    """Print what begins, and whether the robot's file says that its motors don't fit the model."""
    print(escape_unprintable(f"{worlds}; {plan}"), flush=True)
    if plan.update_hint and plan.options.resume is None:
        print(plan.update_hint, flush=True)
    if plan.recipe.note:
        print(escape_unprintable(f"{plan.recipe.file}: {plan.recipe.note}"), flush=True)
    if plan.robot.misfit:
        print(escape_unprintable(f"{plan.options.robot}: {plan.robot.misfit}"), flush=True)


def train(options: TrainingOptions) -> int:
    """Train, save, export, and print the success rate.

    Returns:
        Exit code: 130 if Ctrl-C ended the training early, 143 if SIGTERM did, else 0.
    """
    begin = time.monotonic()
    require_training()
    wait_passively()
    with StopRequest() as stop, contextlib.ExitStack() as batches:
        plan, saved, state = _begin(options, batches)
        env = batches.enter_context(contextlib.closing(plan.make_training_batch()))
        apart = batches.enter_context(contextlib.closing(plan.make_held_out_batch(env)))
        announce_training(plan, held_out.describe_worlds(env, apart))
        from acsar_gym.tools.policies import sb3  # noqa: PLC0415
        from acsar_gym.tools.training import callbacks, models  # noqa: PLC0415

        models.prepare_torch(plan)
        if saved is None:
            model = models.make_model(plan, env)
        else:
            model = models.load_model(plan, env, saved, state)

        describe = partial(
            describe_policy,
            env,
            plan.env_id,
            randomization=plan.randomization,
            state=sb3.recurrent_states(model.policy),
            width=model.observation_space.shape[0],  # type: ignore[index]
        )
        sb3.label(model, describe())
        before = 0.0 if state is None else state.seconds
        scores = callbacks.HeldOutEvaluation(
            apart,
            plan.recipe.steps,
            plan.evaluations,
            target=plan.options.target,
            clock=lambda: time.monotonic() - begin + before,
            file=plan.out / f"{CURVE_NAME}.csv",
            rows=[] if state is None else state.history,
        )
        with checkpoints.explain_disk_errors(plan.out):
            content = record.begin_record(plan)
            keeper = callbacks.CheckpointWriter(
                plan.out / CHECKPOINTS_FOLDER,
                content[record.RUN_KEY]["id"],
                scores,
                plan.options.checkpoint_seconds,
            )
            _learn(plan, state, keeper, model, scores, stop)
            if stop.number is None:
                scores.finish()
            else:
                print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
            commands = content[record.RUN_KEY]["commands"]
            training = record.describe_training(model, plan, commands, scores.clock())
            metrics = held_out.as_metrics(scores.score)
            bundle = describe(training=training, metrics=metrics)
            policy, zipped = record.save_results(model, bundle, plan.out)
            print(escape_unprintable(f"written: {policy} (to drive with), {zipped} (to train on)"))
            if stop.number is None:
                print(describe_score(plan, scores))
                own = "" if plan.env_id.startswith("acsar_gym/") else f" --env {plan.env_id}"
                alone = plan.options.robot and len(env.fleet) == 1
                robot = f" --robot {plan.options.robot}" if alone else ""
                said = f"next: acsar-gym evaluate --policy {policy}{own}{robot}"
                print(escape_unprintable(said))
            if scores.rows:
                title = f"{plan.algorithm.name} on {plan.env_id}, seed {plan.options.seed}"
                held_out.draw_curve(plan.out / f"{CURVE_NAME}.png", scores.rows, title)
            record.finish_record(
                plan,
                content,
                steps=model.num_timesteps,
                seconds=round(scores.clock(), 2),
                finished=stop.number is None,
                held_out=scores.rows[-1] if scores.rows else None,
                episodes=apart.num_envs,
            )
        return stop.exit_code


def describe_score(plan: TrainingPlan, scores: HeldOutEvaluation) -> str:
    """Say how good the policy is, and whether a target was reached."""
    score = scores.score
    if score is None:
        return ""
    wins = round(score.success_rate * score.episodes)
    said = f"{scores.name}: {wins} of {score.episodes} episodes ({score.success_rate:.1%})"
    if plan.options.target is None:
        return said
    how = "reached" if scores.reached else "not reached"
    at = f"{int(scores.rows[-1]['steps']):,} steps"
    return f"{said}; target of {plan.options.target:.1%} {how} at {at}"


def _begin(
    options: TrainingOptions, claims: contextlib.ExitStack
) -> tuple[TrainingPlan, ZipPolicy | None, TrainingState | None]:
    """Find out what to train, in a folder that `claims` keeps other trainings out of."""
    goes_on = options.resume is not None and options.resume.is_dir()
    if options.resume is not None and goes_on:  # before its checkpoints are read
        record.read_record(options.resume)  # before anything is written to it
        claims.enter_context(record.claim_folder(options.resume, resume=True))
    options, saved, state = record.find_start(options)
    plan = TrainingPlan.of(options)
    if not goes_on:
        claim = record.claim_folder(plan.out, numbered=options.out is None)
        plan = replace(plan, out=claims.enter_context(claim))
    return plan, saved, state


def _learn(
    plan: TrainingPlan,
    state: TrainingState | None,
    keeper: CheckpointWriter,
    model: BaseAlgorithm,
    scores: HeldOutEvaluation,
    stop: StopRequest,
) -> None:
    """Train, until all steps are done, the target is reached, or a signal arrives."""
    from acsar_gym.tools.training import callbacks  # noqa: PLC0415

    cohorts = callbacks.WholeCohorts(plan.episode_steps)
    watching: list[BaseCallback] = [keeper, callbacks.EndOnSignal(stop), cohorts, scores]
    if plan.options.progress:
        before = None if state is None else 0
        watching.append(callbacks.TrainingProgress(plan.recipe.steps, scores, before))
    steps = plan.recipe.steps
    if state is not None:
        steps -= state.steps
        print(f"going on at {state.steps:,} steps, with new episodes", flush=True)
    try:
        with contextlib.suppress(callbacks.TargetReached):
            anew = plan.options.resume is None
            model.learn(steps, callback=watching, reset_num_timesteps=anew)
            if stop.number is None:
                keeper.write_checkpoint()
    finally:
        for each in watching:  # restores the terminal in any case; idempotent
            each.on_training_end()

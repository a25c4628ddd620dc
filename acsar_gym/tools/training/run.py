"""Runs a training: batches, model, callbacks, and what is left of it in its folder."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import escape_unprintable
from acsar_gym.tools.policies.bundle import Bundle
from acsar_gym.tools.policies.describe import describe_policy
from acsar_gym.tools.training import checkpoints, held_out, record
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER, StopRequest
from acsar_gym.tools.training.plan import (
    TrainingOptions,
    TrainingPlan,
    require_training,
    wait_passively,
)
from acsar_gym.tools.training.record import TrainingStart
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.tools.training import callbacks

CURVE_NAME = "learning_curve"


def train(options: TrainingOptions) -> int:
    """Train, save, export, and print the success rate.

    Args:
        options: the user's options.

    Returns:
        Exit code: 130 if Ctrl-C ended the training early, 143 if SIGTERM did, else 0.
    """
    begin = time.monotonic()
    require_training()
    wait_passively()
    with StopRequest() as stop, contextlib.ExitStack() as batches:
        start = record.find_start(options)
        plan = TrainingPlan.of(start.options)
        env = batches.enter_context(contextlib.closing(plan.make_training_batch()))
        apart = batches.enter_context(contextlib.closing(plan.make_held_out_batch(env)))
        print(escape_unprintable(f"{held_out.describe_worlds(env, apart)}; {plan}"), flush=True)
        if plan.robot.misfit:
            print(escape_unprintable(f"{options.robot}: {plan.robot.misfit}"), flush=True)
        _Training(plan, start, env, apart, stop).run(begin)
        return stop.exit_code


@dataclass
class _Training:
    """One training."""

    plan: TrainingPlan
    start: TrainingStart
    env: RobotVectorEnv
    apart: RobotVectorEnv
    stop: StopRequest

    def run(self, begin: float) -> None:
        """Train, save, and print the score unless a signal ended the training.

        Args:
            begin: when the training began, by `time.monotonic` [s].
        """
        from acsar_gym.tools.policies import sb3  # noqa: PLC0415
        from acsar_gym.tools.training import callbacks, models  # noqa: PLC0415

        plan, state, saved = self.plan, self.start.state, self.start.saved
        models.prepare_torch(plan)
        if saved is None:
            model = models.make_model(plan, self.env)
        else:
            model = models.load_model(plan, self.env, saved, go_on=state is not None)
        sb3.label(model, self._describe(model))
        before = 0.0 if state is None else state.seconds
        scores = callbacks.HeldOutEvaluation(
            self.apart,
            plan.recipe.steps,
            plan.evaluations,
            target=plan.options.target,
            clock=lambda: time.monotonic() - begin + before,
            file=plan.out / f"{CURVE_NAME}.csv",
            rows=[] if state is None else state.history,
        )
        with checkpoints.explain_disk_errors(plan.out):
            content = record.begin_record(plan)
            reached = self._learn(model, scores)
            if self.stop.number is None:
                scores.finish()
            else:
                print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
            training = record.describe_training(
                model, content[record.RUN_KEY]["commands"], plan.recipe.as_dict(), scores.clock()
            )
            metrics = {} if scores.score is None else {"held_out": asdict(scores.score)}
            bundle = self._describe(model, training=training, metrics=metrics)
            policy, zipped = record.save_results(model, bundle, plan.out)
            said = f"written: {policy} (to drive with), {zipped} (to train on)"
            print(escape_unprintable(said))
            if self.stop.number is None:
                self._print_score(scores, policy, reached=reached)
            if scores.rows:
                title = f"{plan.algorithm.name} on {plan.env_id}, seed {plan.options.seed}"
                held_out.draw_curve(plan.out / f"{CURVE_NAME}.png", scores.rows, title)
            record.finish_record(
                plan,
                content,
                steps=model.num_timesteps,
                seconds=round(scores.clock(), 2),
                finished=self.stop.number is None,
                held_out=scores.rows[-1] if scores.rows else None,
                episodes=self.apart.num_envs,
            )

    def _describe(self, model: BaseAlgorithm, **facts: Any) -> Bundle:
        """Describe the policy; `facts` are what is known at the end."""
        from acsar_gym.tools.policies import sb3  # noqa: PLC0415

        varied, state = self.plan.randomization, sb3.recurrent_states(model.policy)
        return describe_policy(
            self.env, self.plan.env_id, randomization=varied, state=state, **facts
        )

    def _learn(self, model: BaseAlgorithm, scores: callbacks.HeldOutEvaluation) -> bool:
        """Train; returns whether the target ended it."""
        from acsar_gym.tools.training import callbacks  # noqa: PLC0415

        plan, options, state = self.plan, self.plan.options, self.start.state
        folder, seconds = plan.out / CHECKPOINTS_FOLDER, options.checkpoint_seconds
        keeper = callbacks.CheckpointWriter(folder, self.env, scores, seconds, state)
        cohorts = callbacks.WholeCohorts(plan.episode_steps)
        watching: list[BaseCallback] = [keeper, callbacks.EndOnSignal(self.stop), cohorts, scores]
        if options.progress:
            before = None if state is None else 0
            watching.append(callbacks.TrainingProgress(plan.recipe.steps, scores, before))
        steps = plan.recipe.steps
        if state is not None:
            steps -= state.steps
            how = "" if state.exact else ", with new episodes: the task is in Python"
            print(f"going on at {state.steps:,} steps{how}", flush=True)
        try:
            model.learn(steps, callback=watching, reset_num_timesteps=options.resume is None)
            if self.stop.number is None:
                keeper.write_checkpoint()
        except callbacks.TargetReached:
            return True
        finally:
            for each in watching:  # restores the terminal in any case; idempotent
                each.on_training_end()
        return False

    def _print_score(
        self, scores: callbacks.HeldOutEvaluation, policy: Path, *, reached: bool
    ) -> None:
        """Print the score and the next command."""
        plan, score = self.plan, scores.score
        if score is None:
            return
        wins = round(score.success_rate * score.episodes)
        said = f"{scores.name}: {wins} of {score.episodes} episodes ({score.success_rate:.1%})"
        if plan.options.target is not None:
            steps = int(scores.rows[-1]["steps"])
            how = "reached" if reached else "not reached"
            said += f"; target of {plan.options.target:.1%} {how} at {steps:,} steps"
        print(said)
        env = "" if plan.env_id.startswith("acsar_gym/") else f" --env {plan.env_id}"
        robot = f" --robot {plan.options.robot}" if plan.options.robot else ""
        print(escape_unprintable(f"next: acsar-gym evaluate --policy {policy}{env}{robot}"))

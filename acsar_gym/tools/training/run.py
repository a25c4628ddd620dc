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
from acsar_gym.tools.training import held_out, record, threads
from acsar_gym.tools.training.checkpoints import StopRequest
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.tools.training.record import CHECKPOINTS_FOLDER, TrainingStart
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.tools.training import callbacks, keeping

CURVE_NAME = "learning_curve"


def train(options: TrainingOptions) -> int:
    """Train, save, export, and print the success rate.

    Args:
        options: the user's options.

    Returns:
        Exit code: 130 if Ctrl-C ended the training early, 143 if SIGTERM did, else 0.
    """
    begin = time.monotonic()
    options.check()
    threads.wait_passively()
    with StopRequest() as stop, contextlib.ExitStack() as batches:
        start = record.find_start(options)
        plan = TrainingPlan.of(start.options)
        env = batches.enter_context(contextlib.closing(plan.learning()))
        apart = batches.enter_context(contextlib.closing(plan.held_out(env)))
        print(escape_unprintable(f"{held_out.describe_worlds(env, apart)}; {plan}"), flush=True)
        _Training(plan, start, env, apart, stop, begin).run()
        return stop.exit_code


@dataclass
class _Training:
    """One training."""

    plan: TrainingPlan
    start: TrainingStart
    env: RobotVectorEnv
    apart: RobotVectorEnv
    stop: StopRequest
    begin: float
    """By `time.monotonic` [s]."""

    def run(self) -> None:
        """Train, save, and print the score unless a signal ended the training."""
        from acsar_gym.tools.training import keeping, models  # noqa: PLC0415

        models.prepare_torch(self.plan)
        model, out = self._model(), self.plan.out
        before = 0.0 if self.start.state is None else self.start.state.seconds
        scores = self._scores(model, keeping.TrainingClock(self.begin, before))
        with keeping.explain_disk_errors(out):
            content = record.begin_record(self.plan)
            reached = self._learn(model, scores)
            if self.stop.number is None:
                scores.finish()
            else:
                print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
            policy = self._save(model, scores, content[record.RUN_KEY]["commands"])
            if self.stop.number is None:
                self._tell(scores, policy, reached=reached)
            self._record(content, model, scores)

    def _model(self) -> BaseAlgorithm:
        """Make a new model, or load the one to resume."""
        from acsar_gym.tools.policies import sb3  # noqa: PLC0415
        from acsar_gym.tools.training import models  # noqa: PLC0415

        saved, go_on = self.start.saved, self.start.state is not None
        if saved is None:
            model = models.make_model(self.plan, self.env)
        else:
            model = models.load_model(self.plan, self.env, saved, go_on=go_on)
        sb3.label(model, self._bundle(model))
        return model

    def _bundle(self, model: BaseAlgorithm, **facts: Any) -> Bundle:
        """Describe the policy; `facts` are what is known at the end."""
        from acsar_gym.tools.policies import sb3  # noqa: PLC0415

        varied, state = self.plan.randomization, sb3.recurrent_states(model.policy)
        return describe_policy(
            self.env, self.plan.env_id, randomization=varied, state=state, **facts
        )

    def _scores(
        self, model: BaseAlgorithm, clock: keeping.TrainingClock
    ) -> callbacks.HeldOutEvaluation:
        """Make the callback that evaluates."""
        from acsar_gym.tools.training import callbacks  # noqa: PLC0415

        plan, state = self.plan, self.start.state
        return callbacks.HeldOutEvaluation(
            self.apart,
            plan.recipe.steps,
            plan.evaluations,
            target=plan.options.target,
            clock=clock,
            file=plan.out / f"{CURVE_NAME}.csv",
            rows=[] if state is None else state.history,
        )

    def _learn(self, model: BaseAlgorithm, scores: callbacks.HeldOutEvaluation) -> bool:
        """Train; returns whether the target ended it."""
        from acsar_gym.tools.training import callbacks, keeping, states  # noqa: PLC0415

        plan, state = self.plan, self.start.state
        folder, seconds = plan.out / CHECKPOINTS_FOLDER, plan.options.checkpoint_seconds
        keeper = keeping.CheckpointWriter(folder, self.env, scores, seconds, state)
        watching = [keeper, *self._watching(scores)]
        steps = plan.recipe.steps - (0 if state is None else state.steps)
        if state is not None:
            how = (
                ""
                if states.resumes_exactly(state)
                else ", with new episodes: the task is in Python"
            )
            print(f"going on at {state.steps:,} steps{how}", flush=True)
        fresh = plan.options.resume is None
        try:
            model.learn(steps, callback=watching, reset_num_timesteps=fresh)
            if self.stop.number is None:
                keeper.write()
        except callbacks.TargetReached:
            return True
        finally:
            for each in watching:  # restores the terminal in any case; idempotent
                each.on_training_end()
        return False

    def _watching(self, scores: callbacks.HeldOutEvaluation) -> list[BaseCallback]:
        """Make the other callbacks of the training."""
        from acsar_gym.tools.training import callbacks  # noqa: PLC0415

        cohorts = callbacks.WholeCohorts(self.plan.episode_steps)
        watching: list[BaseCallback] = [callbacks.EndOnSignal(self.stop), cohorts, scores]
        if self.plan.options.progress:
            total = self.plan.recipe.steps
            before = None if self.start.state is None else 0
            watching.append(callbacks.TrainingProgress(total, scores, before))
        return watching

    def _save(
        self, model: BaseAlgorithm, scores: callbacks.HeldOutEvaluation, commands: list[list[str]]
    ) -> Path:
        """Write the model and the policy; returns the path of the policy."""
        from acsar_gym.tools.training import record  # noqa: PLC0415

        plan, score = self.plan, scores.score
        training = record.describe_training(model, commands, plan.recipe.as_dict(), scores.clock())
        metrics = {} if score is None else {"held_out": asdict(score)}
        bundle = self._bundle(model, training=training, metrics=metrics)
        policy, zipped = record.save_results(model, bundle, plan.out)
        print(escape_unprintable(f"written: {policy} (to drive with), {zipped} (to train on)"))
        return policy

    def _tell(self, scores: callbacks.HeldOutEvaluation, policy: Path, *, reached: bool) -> None:
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

    def _record(
        self, content: dict[str, Any], model: BaseAlgorithm, scores: callbacks.HeldOutEvaluation
    ) -> None:
        """Write the picture of the learning curve, and what the training came to."""
        from acsar_gym.tools.training import held_out  # noqa: PLC0415

        plan = self.plan
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

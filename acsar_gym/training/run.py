"""Runs a training: batches, model, callbacks, and what is left of it in its folder."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import printable
from acsar_gym.policies.bundle import Bundle
from acsar_gym.policies.describing import described
from acsar_gym.training import held_out, record, resuming, threads
from acsar_gym.training.options import Options
from acsar_gym.training.plan import Plan
from acsar_gym.training.resuming import CHECKPOINTS, Start
from acsar_gym.training.signals import StopRequest
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:  # torch takes seconds to import, and isn't needed for --help
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from acsar_gym.training import callbacks, keeping

CURVE = "learning_curve"


def train(options: Options) -> int:
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
        start = resuming.start(options)
        plan = Plan.of(start.options)
        env = batches.enter_context(contextlib.closing(plan.learning()))
        apart = batches.enter_context(contextlib.closing(plan.held_out(env)))
        print(printable(f"{held_out.told(env, apart)}; {plan}"), flush=True)
        _Training(plan, start, env, apart, stop, begin).run()
        return stop.exit_code


@dataclass
class _Training:
    """One training."""

    plan: Plan
    start: Start
    env: RobotVectorEnv
    apart: RobotVectorEnv
    stop: StopRequest
    begin: float
    """By `time.monotonic` [s]."""

    def run(self) -> None:
        """Train, save, and print the score unless a signal ended the training."""
        from acsar_gym.training import keeping, models  # noqa: PLC0415

        models.prepare(self.plan)
        model, out = self._model(), self.plan.out
        before = 0.0 if self.start.state is None else self.start.state.seconds
        scores = self._scores(model, keeping.Clock(self.begin, before))
        with keeping.on_disk(out):
            content = record.begin(self.plan)
            reached = self._learn(model, scores)
            if self.stop.number is None:
                scores.finish()
            else:
                print(f"interrupted at {model.num_timesteps:,} steps: saving what there is")
            policy = self._save(model, scores, content[record.RUN]["commands"])
            if self.stop.number is None:
                self._tell(scores, policy, reached=reached)
            self._record(content, model, scores)

    def _model(self) -> BaseAlgorithm:
        """Make a new model, or load the one to resume."""
        from acsar_gym.policies import sb3  # noqa: PLC0415
        from acsar_gym.training import models  # noqa: PLC0415

        saved, go_on = self.start.saved, self.start.state is not None
        if saved is None:
            model = models.made(self.plan, self.env)
        else:
            model = models.loaded(self.plan, self.env, saved, go_on=go_on)
        sb3.label(model, self._bundle(model))
        return model

    def _bundle(self, model: BaseAlgorithm, **facts: Any) -> Bundle:
        """Describe the policy; `facts` are what is known at the end."""
        from acsar_gym.policies import sb3_export  # noqa: PLC0415

        varied, state = self.plan.randomization, sb3_export.states(model.policy)
        return described(self.env, self.plan.env_id, randomization=varied, state=state, **facts)

    def _scores(self, model: BaseAlgorithm, clock: keeping.Clock) -> callbacks.HeldOut:
        """Make the callback that evaluates."""
        from acsar_gym.training import callbacks  # noqa: PLC0415

        plan, state = self.plan, self.start.state
        return callbacks.HeldOut(
            self.apart,
            plan.recipe.steps,
            plan.evaluations,
            target=plan.options.target,
            clock=clock,
            file=plan.out / f"{CURVE}.csv",
            rows=[] if state is None else state.history,
        )

    def _learn(self, model: BaseAlgorithm, scores: callbacks.HeldOut) -> bool:
        """Train; returns whether the target ended it."""
        from acsar_gym.training import callbacks, keeping, states  # noqa: PLC0415

        plan, state = self.plan, self.start.state
        folder, seconds = plan.out / CHECKPOINTS, plan.options.checkpoint_seconds
        keeper = keeping.Checkpoints(folder, self.env, scores, seconds, state)
        watching = [keeper, *self._watching(scores)]
        steps = plan.recipe.steps - (0 if state is None else state.steps)
        if state is not None:
            how = "" if states.exact(state) else ", with new episodes: the task is in Python"
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

    def _watching(self, scores: callbacks.HeldOut) -> list[BaseCallback]:
        """Make the other callbacks of the training."""
        from acsar_gym.training import callbacks  # noqa: PLC0415

        cohorts = callbacks.WholeCohorts(self.plan.episode_steps)
        watching: list[BaseCallback] = [callbacks.EndOnSignal(self.stop), cohorts, scores]
        if self.plan.options.progress:
            total = self.plan.recipe.steps
            before = None if self.start.state is None else 0
            watching.append(callbacks.TrainingProgress(total, scores, before))
        return watching

    def _save(
        self, model: BaseAlgorithm, scores: callbacks.HeldOut, commands: list[list[str]]
    ) -> Path:
        """Write the model and the policy; returns the path of the policy."""
        from acsar_gym.training import saving  # noqa: PLC0415

        plan, score = self.plan, scores.score
        training = saving.told(model, commands, plan.recipe.as_dict(), scores.clock())
        metrics = {} if score is None else {"held_out": asdict(score)}
        bundle = self._bundle(model, training=training, metrics=metrics)
        policy, zipped = saving.save(model, bundle, plan.out)
        print(printable(f"written: {policy} (to drive with), {zipped} (to train on)"))
        return policy

    def _tell(self, scores: callbacks.HeldOut, policy: Path, *, reached: bool) -> None:
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
        print(printable(f"next: acsar-gym evaluate --policy {policy}{env}{robot}"))

    def _record(
        self, content: dict[str, Any], model: BaseAlgorithm, scores: callbacks.HeldOut
    ) -> None:
        """Write the picture of the learning curve, and what the training came to."""
        from acsar_gym.training import history  # noqa: PLC0415

        plan = self.plan
        if scores.rows:
            title = f"{plan.algorithm.name} on {plan.env_id}, seed {plan.options.seed}"
            history.draw(plan.out / f"{CURVE}.png", scores.rows, title)
        record.finish(
            plan,
            content,
            steps=model.num_timesteps,
            seconds=round(scores.clock(), 2),
            finished=self.stop.number is None,
            held_out=scores.rows[-1] if scores.rows else None,
            episodes=self.apart.num_envs,
        )

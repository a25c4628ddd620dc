"""Callbacks of a training: held-out scores, checkpoints, progress, and early end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym.tools.evaluation.metrics import Summary
from acsar_gym.tools.training import checkpoints, held_out, models
from acsar_gym.tools.training.checkpoints import StopRequest, TrainingState
from acsar_gym.vector.env import RobotVectorEnv


class TargetReached(Exception):  # noqa: N818 - ends a training, and isn't an error
    """The held-out success rate has reached the target."""


class RolloutCallback(BaseCallback):
    """A callback that does nothing within a rollout."""

    def _on_step(self) -> bool:
        return True


class HeldOutEvaluation(RolloutCallback):
    """Evaluates the deterministic policy on a batch of robots that isn't used for training.

    It does so after the first rollout, then up to `evaluations` times, and when `finish` is called.
    Scores are logged as eval/success_rate, eval/collision_rate, eval/struck_rate,
    eval/mean_return and eval/mean_length. A score that reaches the target raises TargetReached.

    Attributes:
        score: the newest score; None before the first one.
        reached: whether it has reached the target.
        name: label of the success rate, for output.
        rows: the learning curve; `held_out.CURVE_COLUMNS` are its columns.
    """

    def __init__(
        self,
        batch: RobotVectorEnv,
        steps: int,
        evaluations: int,
        *,
        target: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        file: Path | None = None,
        rows: held_out.Rows | None = None,
    ) -> None:
        super().__init__()
        self._batch, self._target, self.clock, self._file = batch, target, clock, file
        self._interval = max(1, steps // evaluations)
        self.rows: held_out.Rows = list(rows or [])
        self.score: Summary | None = None
        self.reached = False
        self.name = held_out.success_label(batch)

    def _on_rollout_end(self) -> None:
        last = self.rows[-1]["steps"] if self.rows else -self._interval
        if self.num_timesteps // self._interval > last // self._interval:
            score = self._evaluate()
            self.reached = self._target is not None and score.success_rate >= self._target
            if self.reached:
                raise TargetReached

    def finish(self) -> Summary:
        """Return the score of the policy after its last update."""
        if self.reached and self.score is not None:
            return self.score
        score = self._evaluate()
        self.logger.dump(self.num_timesteps)
        return score

    def _evaluate(self) -> Summary:
        """Evaluate the policy and log the score."""
        score = held_out.evaluate_held_out(self._batch, models.make_decider(self.model))
        row = held_out.curve_figures(score)
        for name, value in row.items():
            self.logger.record(f"eval/{name}", value)
        self.score = score
        if self.rows and self.rows[-1]["steps"] == self.num_timesteps:
            self.rows.pop()  # before the last update
        self.rows.append({"steps": self.num_timesteps, "seconds": round(self.clock(), 2), **row})
        if self._file is not None:
            held_out.write_curve(self._file, self.rows)
        return score


class CheckpointWriter(RolloutCallback):
    """Writes a checkpoint between two rollouts, whenever some time has passed."""

    def __init__(self, folder: Path, run: str, scores: HeldOutEvaluation, seconds: float) -> None:
        super().__init__()
        self._folder, self._run = folder, run
        self._scores, self._seconds = scores, seconds
        self._due = self._written = 0.0

    def _on_training_start(self) -> None:
        self._due = time.monotonic() + self._seconds
        self._written = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        if time.monotonic() >= self._due:
            self.write_checkpoint()
            self._due = time.monotonic() + self._seconds

    def write_checkpoint(self) -> None:
        """Write a checkpoint, unless there is one of so many steps; only between two rollouts."""
        if self.model.num_timesteps > self._written:
            state = TrainingState(
                self._run, self.model.num_timesteps, self._scores.clock(), self._scores.rows
            )
            checkpoints.write_checkpoint(self._folder, self.model, state)
            self._written = self.model.num_timesteps


class WholeCohorts(RolloutCallback):
    """Keeps the biased statistics of the first episodes out of the log.

    stable-baselines3 logs means over the last finished episodes. All robots of a batch start at the
    same time, so the first episodes to finish are quick successes, and the failures follow all at
    once. So rollout/success_rate isn't logged, and rollout/ep_rew_mean and ep_len_mean only once
    every robot has finished an episode.
    """

    def __init__(self, episode_steps: int) -> None:
        super().__init__()
        self._episode_steps = episode_steps

    def _on_rollout_end(self) -> None:
        buffers: Any = self.model
        buffers.ep_success_buffer.clear()
        if self.num_timesteps < self._episode_steps * self.training_env.num_envs:
            buffers.ep_info_buffer.clear()


class TrainingProgress(RolloutCallback):
    """Shows a progress bar with env steps per second and the newest held-out success rate.

    If the output isn't a terminal, it prints one line per evaluation instead.
    """

    def __init__(self, steps: int, scores: HeldOutEvaluation, before: int | None = None) -> None:
        super().__init__()
        self._steps, self._scores, self._not_counted = steps, scores, before
        self._shown: Summary | None = None
        self._progress = Progress(
            BarColumn(),
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} steps"),
            TextColumn(f"{{task.fields[speed]:,.0f}} steps/s, {scores.name} {{task.fields[rate]}}"),
            TimeElapsedColumn(),
        )
        self._progress.disable = not self._progress.console.is_terminal
        self._task: TaskID = self._progress.add_task("train", total=steps, speed=0.0, rate="-")
        self._begin = 0.0
        self._begun_at = self._before = 0

    def _on_training_start(self) -> None:
        self._begin = time.monotonic()
        self._begun_at = self.num_timesteps
        self._before = self._begun_at if self._not_counted is None else self._not_counted
        self._progress.start()

    def _on_rollout_end(self) -> None:
        done, score = self.num_timesteps - self._before, self._scores.score
        speed = (self.num_timesteps - self._begun_at) / (time.monotonic() - self._begin)
        total, rate = max(done, self._steps), f"{score.success_rate:.1%}" if score else "-"
        self._progress.update(self._task, completed=done, total=total, speed=speed, rate=rate)
        if self._progress.disable and score is not self._shown:
            print(
                f"{done:,} of {total:,} steps, {speed:,.0f} a second, {self._scores.name} {rate}",
                flush=True,
            )
        self._shown = score

    def _on_training_end(self) -> None:
        self._progress.stop()


class EndOnSignal(BaseCallback):
    """Ends the training after the step during which a signal arrived."""

    def __init__(self, stop: StopRequest) -> None:
        super().__init__()
        self._stop = stop

    def _on_step(self) -> bool:
        self._stop.defer()
        return self._stop.number is None

"""Callbacks for training with stable-baselines3: held-out scores, progress, and early end."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym.training import held_out
from acsar_gym.training.held_out import Score
from acsar_gym.training.signals import StopRequest
from acsar_gym.vector.env import RobotVectorEnv


class HeldOut(BaseCallback):
    """Evaluates the deterministic policy on a batch of robots that isn't used for training.

    It does so after the first rollout, then up to `evaluations` times, and when `finish` is called.
    Scores are logged as eval/success_rate, eval/collision_rate, eval/mean_return and
    eval/mean_length.

    Args:
        batch: robots to evaluate on.
        steps: env steps of the training.
        evaluations: largest number of evaluations during the training.

    Attributes:
        score: the newest score; None before the first one.
        name: label of the success rate, for output.
    """

    def __init__(self, batch: RobotVectorEnv, steps: int, evaluations: int) -> None:
        super().__init__()
        self._batch = batch
        self._interval = max(1, steps // evaluations)
        self._next = 0
        self.score: Score | None = None
        self.name = held_out.measured(batch)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._interval
            self._evaluate()

    def finish(self) -> Score:
        """Evaluate the policy after its last update."""
        score = self._evaluate()
        self.logger.dump(self.num_timesteps)
        return score

    def _evaluate(self) -> Score:
        """Evaluate the policy and log the score."""
        with torch.no_grad():
            score = held_out.evaluate(self._batch, self._decide)
        for name in ("success_rate", "collision_rate", "mean_return", "mean_length"):
            self.logger.record(f"eval/{name}", getattr(score, name))
        self.score = score
        return score

    def _decide(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute deterministic actions (n, 2), in half the time of the policy's `predict`."""
        policy: Any = self.model.policy
        mean: torch.Tensor = policy.get_distribution(torch.from_numpy(seen)).mode()
        clipped: NDArray[np.float32] = np.clip(mean.numpy(), -1.0, 1.0)
        return clipped


class WholeCohorts(BaseCallback):
    """Keeps the biased statistics of the first episodes out of the log.

    stable-baselines3 logs means over the last finished episodes. All robots of a batch start at the
    same time, so the first episodes to finish are quick successes, and the failures follow all at
    once. So rollout/success_rate isn't logged, and rollout/ep_rew_mean and ep_len_mean only once
    every robot has finished an episode.

    Args:
        episode_steps: time limit of an episode [steps].
    """

    def __init__(self, episode_steps: int) -> None:
        super().__init__()
        self._episode_steps = episode_steps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffers: Any = self.model
        buffers.ep_success_buffer.clear()
        if self.n_calls < self._episode_steps:
            buffers.ep_info_buffer.clear()


class TrainingProgress(BaseCallback):
    """Shows a progress bar with env steps per second and the newest held-out success rate.

    If the output isn't a terminal, it prints one line per evaluation instead.

    Args:
        steps: env steps of the training.
        scores: the callback that evaluates.
    """

    def __init__(self, steps: int, scores: HeldOut) -> None:
        super().__init__()
        self._steps, self._scores = steps, scores
        self._shown: Score | None = None
        self._progress = Progress(
            BarColumn(),
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} steps"),
            TextColumn(f"{{task.fields[speed]:,.0f}} steps/s, {scores.name} {{task.fields[rate]}}"),
            TimeElapsedColumn(),
        )
        self._progress.disable = not self._progress.console.is_terminal
        self._task: TaskID = self._progress.add_task("train", total=steps, speed=0.0, rate="-")
        self._begin = 0.0
        self._before = 0

    def _on_training_start(self) -> None:
        self._begin = time.monotonic()
        self._before = self.num_timesteps
        self._progress.start()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        done, score = self.num_timesteps - self._before, self._scores.score
        speed = done / (time.monotonic() - self._begin)
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
    """Ends the training after the step during which a signal arrived.

    Args:
        stop: the open context that receives the signals.
    """

    def __init__(self, stop: StopRequest) -> None:
        super().__init__()
        self._stop = stop

    def _on_step(self) -> bool:
        self._stop.defer()
        return self._stop.number is None

"""Callbacks of a training: held-out scores, checkpoints, and progress. Imports torch."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym.tools.evaluation.metrics import Summary
from acsar_gym.tools.training import folders, held_out
from acsar_gym.tools.training.held_out import Curve, Decide
from acsar_gym.vector.env import RobotVectorEnv


class TargetReached(Exception):  # noqa: N818 - ends a training, and isn't an error
    """The held-out success rate has reached the target."""


class RolloutCallback(BaseCallback):
    """A callback that does nothing within a rollout."""

    def _on_step(self) -> bool:
        return True


class HeldOutScores(RolloutCallback):
    """Evaluates the deterministic policy on a batch of robots that isn't used for training.

    It does so after the first rollout, then up to `evaluations` times, and when `finish` is called.
    Scores are logged under eval/. A score that reaches the target raises TargetReached.

    Attributes:
        score: The newest score; None before the first one.
        curve: The learning curve.
        name: Label of the success rate, for output.
    """

    def __init__(
        self,
        batch: RobotVectorEnv,
        curve: Curve,
        interval: int,
        *,
        target: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._batch = batch
        self._interval = interval
        self._target = 2.0 if target is None else target
        self._clock = clock

        self.curve = curve
        self.score: Summary | None = None
        self.name = held_out.success_label(batch)

    @property
    def is_reached(self) -> bool:
        """Whether the newest score has reached the target."""
        return self.score is not None and self.score.success_rate >= self._target

    def _on_rollout_end(self) -> None:
        rows = self.curve.rows
        last = rows[-1]["steps"] if rows else -self._interval
        if self.num_timesteps // self._interval > last // self._interval:
            self._evaluate()
            if self.is_reached:
                raise TargetReached

    def finish(self) -> None:
        """Score the policy after its last update."""
        if not self.is_reached:
            self._evaluate()
            self.logger.dump(self.num_timesteps)

    def _evaluate(self) -> None:
        """Evaluate the policy and log the score."""
        self.score = held_out.evaluate_held_out(self._batch, make_decider(self.model))
        figures = held_out.curve_figures(self.score)
        for name, value in figures.items():
            self.logger.record(f"eval/{name}", value)
        seconds = round(self._clock(), 2)
        self.curve.append({"steps": self.num_timesteps, "seconds": seconds, **figures})


def make_decider(model: BaseAlgorithm) -> Decide:
    """Return a function from observations (n, m) to deterministic actions (n, 2).

    A recurrent policy's state starts at the first call, and is kept for all robots from then on.
    """
    space: Any = model.observation_space
    state: tuple[NDArray[Any], ...] | None = None

    def decide(observations: NDArray[np.float32]) -> NDArray[Any]:
        nonlocal state
        starts = np.full(len(observations), state is None)
        kept = np.ascontiguousarray(observations[:, : space.shape[0]])
        actions, state = model.predict(kept, state, starts, deterministic=True)
        return actions

    return decide


class CheckpointWriter(RolloutCallback):
    """Writes a checkpoint between two rollouts, whenever some time has passed."""

    def __init__(self, folder: Path, seconds: float) -> None:
        super().__init__()
        self._folder = folder
        self._seconds = seconds
        self._written = time.monotonic()

    def _on_training_start(self) -> None:
        self._written = time.monotonic()

    def _on_rollout_start(self) -> None:
        is_due = time.monotonic() >= self._written + self._seconds
        if is_due and self.n_calls:
            folders.write_checkpoint(self.model, self._folder)
            self._written = time.monotonic()


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


class TrainingProgress(BaseCallback):
    """Shows a progress bar with env steps per second and the newest held-out success rate.

    If the output isn't a terminal, it prints one line per evaluation instead. The speed is measured
    from the second step on, because the first one compiles.

    Args:
        total: Number of steps at the end of the training.
        scores: The held-out scores.
    """

    def __init__(self, total: int, scores: HeldOutScores) -> None:
        super().__init__()
        self._total = total
        self._scores = scores
        self._shown: Summary | None = None
        self._progress = Progress(
            BarColumn(),
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} steps"),
            TextColumn(f"{{task.fields[speed]:,.0f}} steps/s, {scores.name} {{task.fields[rate]}}"),
            TimeElapsedColumn(),
        )
        self._progress.disable = not self._progress.console.is_terminal
        self._task = self._progress.add_task("train", total=total, speed=0.0, rate="-")
        self._start: tuple[int, float] | None = None

    def _on_training_start(self) -> None:
        self._progress.start()

    def _on_step(self) -> bool:
        if self._start is None:
            self._start = (self.num_timesteps, time.monotonic())
        return True

    def _on_rollout_end(self) -> None:
        steps, seconds = self._start or (0, 0.0)
        speed = (self.num_timesteps - steps) / max(time.monotonic() - seconds, 1e-9)
        score = self._scores.score
        rate = f"{score.success_rate:.1%}" if score else "-"
        total = max(self.num_timesteps, self._total)
        self._progress.update(
            self._task, completed=self.num_timesteps, total=total, speed=speed, rate=rate
        )
        if self._progress.disable and score is not self._shown:
            done = f"{self.num_timesteps:,} of {total:,} steps, {speed:,.0f} a second"
            print(f"{done}, {self._scores.name} {rate}", flush=True)
        self._shown = score

    def _on_training_end(self) -> None:
        self._progress.stop()

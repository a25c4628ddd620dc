"""Callbacks of a training: held-out scores, checkpoints, and progress. Imports torch."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.progress import Progress
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym import reading
from acsar_gym.tools.evaluation.episode import describe_end
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds.crowd import PERSON_HIT

DRAWN_COLUMNS = ("success_rate", "mean_return", "collision_rate")
AXES = {"steps": "env steps", "seconds": "time [s]"}


class Score(NamedTuple):
    """Rates and means over held-out episodes, a row of the learning curve."""

    steps: int
    """Env steps of the training."""
    seconds: float
    """Time since the start of the training."""
    success_rate: float
    collision_rate: float
    """Touched an obstacle, or ran into somebody."""
    struck_rate: float
    """Somebody ran into the robot."""
    mean_return: float
    mean_length: float
    """Policy steps of an episode."""


class TargetReached(Exception):  # noqa: N818 - ends a training, and isn't an error
    """The held-out success rate has reached the target."""


class RolloutCallback(BaseCallback):
    """A callback that does nothing within a rollout."""

    def _on_step(self) -> bool:
        return True


class HeldOutScores(RolloutCallback):
    """Evaluates the deterministic policy on a batch of robots that isn't used for training.

    It does so after the first rollout, then every `interval` steps, and when `finish` is called.
    Scores are logged under eval/ and written to learning_curve.csv. A score that reaches the target
    raises TargetReached.

    Attributes:
        batch: The robots.
        curve: The scores. A training that goes on reads those before its start.
    """

    def __init__(
        self, batch: RobotVectorEnv, out: Path, interval: int, target: float | None = None
    ) -> None:
        super().__init__()
        self.batch = batch
        self.curve: list[Score] = []
        self._file = out / "learning_curve.csv"
        self._interval = interval
        self._target = 2.0 if target is None else target
        self._started = time.monotonic()

    @property
    def score(self) -> Score | None:
        """The newest score. None before the first evaluation."""
        return self.curve[-1] if self.curve else None

    @property
    def is_reached(self) -> bool:
        """Whether a score of the current policy has reached the target."""
        if self.score is None or self.score.steps < self.num_timesteps:
            return False
        return self.score.success_rate >= self._target

    @property
    def seconds(self) -> float:
        """Time since the start of the training [s]."""
        return time.monotonic() - self._started

    def _on_training_start(self) -> None:
        if self._file.exists():
            rows = np.loadtxt(self._file, delimiter=",", skiprows=1, ndmin=2).tolist()
            scores = [Score(int(steps), *figures) for steps, *figures in rows]
            self.curve = [score for score in scores if score.steps <= self.num_timesteps]
        if self.score:
            self._started -= self.score.seconds

    def _on_rollout_end(self) -> None:
        last_steps = self.score.steps if self.score else -self._interval
        if self.num_timesteps // self._interval > last_steps // self._interval:
            self._evaluate()
            if self.is_reached:
                raise TargetReached

    def finish(self) -> None:
        """Score the policy after its last update."""
        if not self.is_reached:
            self._evaluate()
            self.logger.dump(self.num_timesteps)

    def _evaluate(self) -> None:
        """Evaluate the policy, log the score and write the curve."""
        figures = evaluate_held_out(self.model, self.batch)
        for name, value in figures.items():
            self.logger.record(f"eval/{name}", value)

        # The last update has outdated a score of as many steps.
        score = Score(self.num_timesteps, round(self.seconds, 2), **figures)
        self.curve = [*(old for old in self.curve if old.steps < score.steps), score]
        with reading.replace_file(self._file) as new, new.open("w", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([Score._fields, *self.curve])


def evaluate_held_out(model: BaseAlgorithm, batch: RobotVectorEnv) -> dict[str, float]:
    """Run the first episode of every robot to its end, always from the same seeds.

    The batch needs a time limit. One episode per robot avoids a bias: the first n finished
    episodes of a batch would contain too many quick ones.

    Returns:
        The figures of a `Score`.
    """
    space: Any = model.observation_space
    observations, _ = batch.reset(seed=FIRST_HELD_OUT_SEED)
    running = np.ones(batch.num_envs, np.bool_)
    returns = np.zeros(batch.num_envs)
    lengths = np.zeros(batch.num_envs, np.int64)
    ends = []
    state: Any = None

    # Robots whose episode has ended drive on, but don't count.
    while running.any():
        kept = np.ascontiguousarray(observations[:, : space.shape[0]])
        starts = np.full(batch.num_envs, state is None)
        actions, state = model.predict(kept, state, starts, deterministic=True)
        observations, rewards, terminated, truncated, info = batch.step(actions)
        returns += rewards * running
        lengths += running
        ended = running & (terminated | truncated)
        for robot in np.flatnonzero(ended):
            last = {key: row[robot] for key, row in info.items() if not key.startswith("_")}
            ends.append(describe_end(last))
        running &= ~ended

    return {
        "success_rate": fmean(end["success"] for end in ends),
        "collision_rate": fmean(end["collision"] for end in ends),
        "struck_rate": fmean(end["person_contact"] == PERSON_HIT for end in ends),
        "mean_return": fmean(returns),
        "mean_length": fmean(lengths),
    }


def draw_curve(out: Path, curve: list[Score], title: str) -> None:
    """Draw success, return and collisions over steps and over time as a picture in `out`."""
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    plots = figure.subplots(len(DRAWN_COLUMNS), len(AXES), sharey="row", sharex="col")
    for line, column in zip(plots, DRAWN_COLUMNS, strict=True):
        for plot, (axis, label) in zip(line, AXES.items(), strict=True):
            xs = [getattr(score, axis) for score in curve]
            plot.plot(xs, [getattr(score, column) for score in curve], marker=".")
            plot.set(xlabel=label, ylabel=column.replace("_", " "))
            plot.grid(visible=True)
            plot.label_outer()
    with reading.replace_file(out / "learning_curve.png") as new:
        figure.savefig(new, format="png", dpi=100)


class CheckpointWriter(RolloutCallback):
    """Writes a checkpoint between two rollouts, whenever some time has passed."""

    def __init__(self, folder: Path, seconds: float) -> None:
        super().__init__()
        self._folder = folder
        self._seconds = seconds
        self._written = time.monotonic()

    def _on_rollout_start(self) -> None:
        if self.n_calls == 0:  # nothing is learnt yet
            self._written = time.monotonic()
        elif time.monotonic() >= self._written + self._seconds:
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


class TrainingProgress(RolloutCallback):
    """Updates a progress bar with env steps per second and the newest held-out success rate.

    If the bar is disabled, it prints one line per evaluation instead. The speed leaves out the
    first rollout, which compiles.
    """

    def __init__(self, bar: Progress, total: int, scores: HeldOutScores) -> None:
        super().__init__()
        self._bar = bar
        self._task = bar.add_task("", total=total)
        self._scores = scores
        self._shown: Score | None = None

    def _on_rollout_end(self) -> None:
        self._bar.update(self._task, completed=self.num_timesteps)
        task = self._bar.tasks[0]
        score = self._scores.score
        line = f"{task.completed:,.0f} of {task.total:,.0f} steps"
        if task.speed:
            line += f", {task.speed:,.0f} a second"
        if score:
            line += f", held-out success {score.success_rate:.1%}"

        # Without a terminal: a line for each new score.
        self._bar.update(self._task, description=line)
        if self._bar.disable and score is not self._shown:
            print(line, flush=True)
        self._shown = score

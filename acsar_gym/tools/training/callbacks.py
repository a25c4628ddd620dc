"""What happens between the rollouts of a training: scores, checkpoints, progress. Imports torch."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import Progress
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym import reading
from acsar_gym.tools.evaluation.episode import describe_end
from acsar_gym.tools.training import folders
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED
from acsar_gym.tools.training.plan import Score, TrainingPlan
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds.crowd import PERSON_HIT

DRAWN_COLUMNS = ("success_rate", "mean_return", "collision_rate")


class TargetReached(Exception):  # noqa: N818 - ends a training, and isn't an error
    """The held-out success rate has reached the target."""


class TrainingWatch(BaseCallback):
    """Scores the policy, writes checkpoints and shows progress, between two rollouts.

    Scores are of the deterministic policy on a batch of robots that isn't used for training, after
    the first rollout, then at the plan's intervals, and when `finish` is called. They are logged
    under eval/ and written to learning_curve.csv. A score that reaches the target raises
    TargetReached.

    Attributes:
        batch: The robots.
        curve: The scores. A training that goes on reads those before its start.
    """

    def __init__(
        self, plan: TrainingPlan, batch: RobotVectorEnv, out: Path, bar: Progress | None = None
    ) -> None:
        super().__init__()
        self.batch = batch
        self.curve: list[Score] = []
        self._plan = plan
        self._out = out
        self._file = out / "learning_curve.csv"
        self._bar = bar
        # A seed among several has no bar of its own.
        if bar is not None:
            bar.add_task("", total=plan.recipe.steps)
        self._started = time.monotonic()
        self._saved = self._started

    @property
    def score(self) -> Score | None:
        """The newest score. None before the first evaluation."""
        return self.curve[-1] if self.curve else None

    @property
    def is_reached(self) -> bool:
        """Whether a score of the current policy has reached the target."""
        target = self._plan.options.target
        if target is None or self.score is None or self.score.steps < self.num_timesteps:
            return False
        return self.score.success_rate >= target

    @property
    def seconds(self) -> float:
        """Time since the start of the training [s]."""
        return time.monotonic() - self._started

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        if self._file.exists():
            rows = np.loadtxt(self._file, delimiter=",", skiprows=1, ndmin=2).tolist()
            scores = [Score(int(steps), *figures) for steps, *figures in rows]
            self.curve = [score for score in scores if score.steps <= self.num_timesteps]
        # Its clock goes on from there.
        if self.score:
            self._started -= self.score.seconds

    def _on_rollout_start(self) -> None:
        # Nothing is learnt before the first rollout, which also compiles.
        now = time.monotonic()
        if self.n_calls == 0:
            self._saved = now
        elif now >= self._saved + self._plan.options.checkpoint_seconds:
            folders.write_checkpoint(self.model, self._out)
            self._saved = time.monotonic()

    def _on_rollout_end(self) -> None:
        # stable-baselines3 logs means over the last episodes. All robots start at the same time, so
        # the first episodes to end are quick successes: nothing is logged until all have ended one.
        buffers: Any = self.model
        buffers.ep_success_buffer.clear()
        if self.num_timesteps < self._plan.episode_steps * self.training_env.num_envs:
            buffers.ep_info_buffer.clear()

        interval = self._plan.evaluation_interval
        last_steps = self.score.steps if self.score else -interval
        is_due = self.num_timesteps // interval > last_steps // interval
        if is_due:
            self._evaluate()
            if self.is_reached:
                raise TargetReached
        if self._bar is not None:
            self._show_progress(self._bar, is_scored=is_due)

    def _show_progress(self, bar: Progress, *, is_scored: bool) -> None:
        """Update the bar, or print a line for a new score if there is no terminal."""
        (task,) = bar.tasks
        bar.update(task.id, completed=self.num_timesteps)
        line = f"{task.completed:,.0f} of {task.total:,.0f} steps"
        if task.speed:  # it leaves out the first rollout, which compiles
            line += f", {task.speed:,.0f} a second"
        if self.score:
            line += f", held-out success {self.score.success_rate:.1%}"
        bar.update(task.id, description=line)
        if bar.disable and is_scored:
            print(line, flush=True)

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
        folders.write_table(self._file, Score._fields, self.curve)


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
    """Draw success, return and collisions over steps as a picture in `out`."""
    # Without pyplot, which would keep the figure and may open a window.
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    figure.suptitle(title)
    plots = figure.subplots(len(DRAWN_COLUMNS), sharex=True)
    steps = [score.steps for score in curve]
    for plot, column in zip(plots, DRAWN_COLUMNS, strict=True):
        plot.plot(steps, [getattr(score, column) for score in curve], marker=".")
        plot.set(ylabel=column.replace("_", " "))
        plot.grid(visible=True)
    plots[-1].set(xlabel="env steps")
    with reading.replace_file(out / "learning_curve.png") as new:
        figure.savefig(new, format="png", dpi=100)

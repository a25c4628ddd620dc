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

CURVE_FILE = "learning_curve.csv"
DRAWN_COLUMNS = ("success_rate", "mean_return", "collision_rate")


class TargetReached(Exception):  # noqa: N818 - ends a training, and isn't an error
    """The held-out success rate has reached the target."""


class TrainingWatch(BaseCallback):
    """Scores the policy, writes checkpoints and shows progress, between two rollouts.

    Scores are of the deterministic policy on a batch of robots that isn't used for training, after
    the first rollout, then at the plan's intervals, and when `finish` is called. They are printed,
    logged under eval/ and written to learning_curve.csv. A score that reaches the target raises
    TargetReached.

    Attributes:
        curve: The scores. A training that goes on reads those before its start.
    """

    def __init__(self, plan: TrainingPlan, batch: RobotVectorEnv, out: Path, bar: Progress) -> None:
        super().__init__()
        self.curve: list[Score] = []
        self._plan = plan
        self._batch = batch
        self._out = out
        self._bar = bar
        self._task = bar.add_task("training", total=plan.recipe.steps)
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

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        file = self._out / CURVE_FILE
        if file.exists():
            rows = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2).tolist()
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

        self._bar.update(self._task, completed=self.num_timesteps)
        interval = self._plan.evaluation_interval
        last_steps = self.score.steps if self.score else -interval
        if self.num_timesteps // interval > last_steps // interval:
            score = self._evaluate()
            # After the last rollout the policy is updated once more, and scored again.
            if self._plan.options.progress and score.steps < self._plan.recipe.steps:
                self._print(score)
            if self.is_reached:
                raise TargetReached

    def _print(self, score: Score) -> None:
        line = f"{score.steps:,} of {self._plan.recipe.steps:,} steps"
        if speed := self._bar.tasks[0].speed:  # it leaves out the first rollout, which compiles
            line += f", {speed:,.0f} a second"
        print(f"{line}, held-out success {score.success_rate:.1%}", flush=True)

    def finish(self) -> None:
        """Score the policy after its last update."""
        if not self.is_reached:
            self._evaluate()
            self.logger.dump(self.num_timesteps)

    def _evaluate(self) -> Score:
        """Evaluate the policy, log the score and write the curve."""
        figures = evaluate_held_out(self.model, self._batch)
        # SB3 writes them with the figures of the next rollout.
        for name, value in figures.items():
            self.logger.record(f"eval/{name}", value)

        # The last update has outdated a score of as many steps.
        seconds = round(time.monotonic() - self._started, 2)
        score = Score(self.num_timesteps, seconds, **figures)
        self.curve = [*(old for old in self.curve if old.steps < score.steps), score]
        folders.write_table(self._out / CURVE_FILE, Score._fields, self.curve)
        return score


def evaluate_held_out(model: BaseAlgorithm, batch: RobotVectorEnv) -> dict[str, float]:
    """Run the first episode of every robot to its end, always from the same seeds.

    The batch needs a time limit and AutoresetMode.SAME_STEP. One episode per robot avoids a bias:
    the first n finished episodes of a batch would contain too many quick ones.

    Returns:
        The figures of a `Score`.
    """
    space: Any = model.observation_space
    observations, _ = batch.reset(seed=FIRST_HELD_OUT_SEED)
    ends: dict[int, dict[str, Any]] = {}
    state: Any = None

    # Robots whose episode has ended drive on, but only their first end counts.
    while len(ends) < batch.num_envs:
        kept = np.ascontiguousarray(observations[:, : space.shape[0]])
        starts = np.full(batch.num_envs, state is None)
        actions, state = model.predict(kept, state, starts, deterministic=True)
        observations, _, terminated, truncated, info = batch.step(actions)
        for robot in np.flatnonzero(terminated | truncated):
            last = {key: row[robot] for key, row in info["final_info"].items()}
            ends.setdefault(int(robot), {**last, **describe_end(last)})

    figures = ends.values()
    return {
        "success_rate": fmean(end["success"] for end in figures),
        "collision_rate": fmean(end["collision"] for end in figures),
        "struck_rate": fmean(end["person_contact"] == PERSON_HIT for end in figures),
        "mean_return": fmean(end["episode_return"] for end in figures),
        "mean_length": fmean(end["episode_length"] for end in figures),
    }


def draw_curve(out: Path, curve: list[Score], title: str) -> None:
    """Draw success, return and collisions over steps as a picture in `out`."""
    # Without pyplot, which would keep the figure and may open a window.
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    figure.suptitle(title)
    steps = [score.steps for score in curve]
    for plot, column in zip(figure.subplots(len(DRAWN_COLUMNS)), DRAWN_COLUMNS, strict=True):
        plot.plot(steps, [getattr(score, column) for score in curve], marker=".")
        plot.set(xlabel="env steps", ylabel=column.replace("_", " "))
        plot.grid(visible=True)
    with reading.replace_file(out / "learning_curve.png") as new:
        figure.savefig(new, format="png", dpi=100)

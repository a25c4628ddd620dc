"""Scores of a policy that is being trained, and its log."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from rich.progress import Progress
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure

from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.tools.evaluation import episodes
from acsar_gym.tools.policies.sb3 import BatchVecEnv
from acsar_gym.tools.training import callbacks
from acsar_gym.tools.training.callbacks import evaluate_held_out
from acsar_gym.tools.training.options import FIRST_HELD_OUT_SEED
from acsar_gym.tools.training.plan import choose_held_out_worlds
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.pool import Pool

WORLDS = "clutter:900-903"
STEPS = 60
ROBOTS = 6
PEOPLE = World(
    start=Region(0.0, 0.0, 0.0, 0.0),
    goal=Region(4.0, 0.0),
    movers=[walk([[x, -1.0], [x, 1.0]], 1.0, spread=4.0) for x in (0.8, 1.6)],
)


def towards(observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Turn to the goal and drive, through whatever is there."""
    turns = np.clip(2.0 * observations[:, 2], -1.0, 1.0)
    return np.stack([np.ones(len(observations)), turns], axis=1)


def make_model(batch: Any) -> Any:
    """Make a model that drives `towards` the goal."""
    return SimpleNamespace(
        observation_space=batch.single_observation_space,
        predict=lambda observations, *_, **__: (towards(observations), ()),
    )


@pytest.mark.parametrize("worlds", [WORLDS, PEOPLE], ids=["standing", "people"])
def test_evaluate_held_out_agrees_with_evaluation_of_the_same_episodes(worlds: Any) -> None:
    limits: dict[str, Any] = {"max_episode_steps": STEPS, "threads": 1}
    batch = ObstacleGoalVectorEnv(ROBOTS, worlds=worlds, autoreset_mode="SameStep", **limits)
    score = evaluate_held_out(make_model(batch), batch)
    batch.close()

    env = gymnasium.make(
        "acsar_gym/ObstacleGoal-v1", link="planar", worlds=worlds, max_episode_steps=STEPS
    )

    def policy(observation: Any) -> Any:
        return towards(observation[None])[0]

    results = list(episodes.run_episodes(env, policy, ROBOTS, FIRST_HELD_OUT_SEED))
    env.close()
    assert score["success_rate"] == pytest.approx(np.mean([r.success for r in results]))
    assert score["collision_rate"] == pytest.approx(np.mean([r.collision for r in results]))
    assert 0.0 < score["collision_rate"] < 1.0
    struck = np.mean([r.person_contact == 2.0 for r in results])
    assert score["struck_rate"] == pytest.approx(struck)
    assert (score["struck_rate"] > 0.0) == (worlds is PEOPLE)
    returns = np.mean([r.episode_return for r in results])
    assert score["mean_return"] == pytest.approx(returns)
    ticks = np.mean([r.ticks for r in results])
    assert score["mean_length"] == pytest.approx(ticks / 10.0)


@pytest.mark.parametrize(
    ("training", "held_out"),
    [
        ("barn", ["barn:900-963"]),
        ("clutter:1000", ["clutter:1000-1063"]),
        ("clutter:963-1100", ["clutter:1101-1164"]),
        (["clutter:train", "barn:train"], ["clutter:900-931", "barn:900-931"]),
        (PEOPLE, None),
    ],
)
def test_choose_held_out_worlds_takes_other_worlds(training: Any, held_out: Any) -> None:
    """A file has no others."""
    assert choose_held_out_worlds(Pool.of(training)) == held_out
    assert choose_held_out_worlds(None) is None


def test_training_watch_logs_unbiased_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Robots all start at once: the first episodes that end are the successful ones."""
    options: dict[str, Any] = {"goal_distance": (0.3, 0.6), "max_episode_steps": 20}
    options["autoreset_mode"] = "SameStep"
    training = BatchVecEnv(PointGoalVectorEnv(32, **options))
    held_out = PointGoalVectorEnv(4, **options)
    plan: Any = SimpleNamespace(
        recipe=SimpleNamespace(steps=1024),
        options=SimpleNamespace(target=None, checkpoint_seconds=60.0, progress=True),
        episode_steps=20,
        evaluation_interval=64,
    )
    watch = callbacks.TrainingWatch(plan, held_out, tmp_path, Progress(disable=True))
    model = PPO("MlpPolicy", training, n_steps=8, batch_size=256, n_epochs=1)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(1024, callback=watch)
    watch.finish()
    model.logger.close()
    training.close()
    held_out.close()

    with (tmp_path / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert "rollout/success_rate" not in rows[0]
    assert [row["rollout/ep_rew_mean"] != "" for row in rows] == [False, False, True, True, False]
    assert all(row["eval/success_rate"] and row["eval/mean_return"] for row in rows)
    # rich before 15 ends bars with an empty line
    lines = capsys.readouterr().out.strip().splitlines()
    assert lines[0].startswith("256 of 1,024 steps")
    assert "held-out success" in lines[0]
    assert len(lines) == 3  # the score after the last update follows the training

"""What a training logs."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from acsar_gym.envs import PointGoalVectorEnv

STEPS, ROBOTS, LIMIT = 8, 32, 20


def test_only_honest_figures_are_logged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Robots all start at once: the first episodes that end are the successful ones."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure

    from acsar_gym.tools.policies.sb3 import BatchVecEnv
    from acsar_gym.tools.training import callbacks, held_out

    batches = [
        PointGoalVectorEnv(
            robots, goal_distance=(0.3, 0.6), max_episode_steps=LIMIT, autoreset_mode=mode
        )
        for robots, mode in ((ROBOTS, "SameStep"), (4, "NextStep"))
    ]
    total = STEPS * ROBOTS * 4
    scores = callbacks.HeldOutScores(batches[1], held_out.Curve(), total // 16)
    watching: list[BaseCallback] = [callbacks.WholeCohorts(LIMIT), scores]
    watching.append(callbacks.TrainingProgress(total, scores))
    model = PPO("MlpPolicy", BatchVecEnv(batches[0]), n_steps=STEPS, batch_size=256, n_epochs=1)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(total, callback=watching)
    scores.finish()
    for batch in batches:
        batch.close()
    model.logger.close()
    with (tmp_path / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert "rollout/success_rate" not in rows[0]
    assert [row["rollout/ep_rew_mean"] != "" for row in rows] == [False, False, True, True, False]
    assert all(row["eval/success_rate"] for row in rows)
    assert all(row["eval/mean_return"] and row["eval/collision_rate"] for row in rows)
    # rich before 15 ends bars with an empty line
    said = capsys.readouterr().out.strip().splitlines()
    assert said[0].startswith(f"{STEPS * ROBOTS:,} of {total:,} steps, ")
    assert "held-out success" in said[0]
    assert len(said) == 4

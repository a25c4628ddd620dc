"""RL Zoo on our recipes, and its zips as policies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from acsar_gym.resources import AGENTS
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import ZipPolicy

PATIENCE = 1800.0
"""For a subprocess on a busy machine [s]."""
NORMALIZED = """
acsar_gym/PointGoal-v0: {policy: MlpPolicy, n_timesteps: 64, n_envs: 2, normalize: true,
  n_steps: 16, batch_size: 16, env_kwargs: {link: planar}}
"""


def run_zoo(script: str, *arguments: str | Path) -> str:
    """Run a script of rl_zoo3, and return its output."""
    env = ("--env", "acsar_gym/PointGoal-v0", "--gym-packages", "acsar_gym")
    command = [sys.executable, "-m", f"rl_zoo3.{script}", *env, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("algo", ["ppo", "sac", "tqc", "ppo_lstm"])
def test_recipes_train_with_rl_zoo_on_the_batch(algo: str, tmp_path: Path) -> None:
    files = ("--algo", algo, "-f", tmp_path)
    recipe = ("--conf-file", AGENTS / "recipes" / f"{algo}.yml", "--hyperparams", "n_envs:8")
    options = ("-n", "2500", "--eval-freq", "1000", "--eval-episodes", "1")
    output = run_zoo("train", *files, *recipe, *options)
    assert "Using 8 environments" in output
    run_zoo("enjoy", *files, "--no-render", "-n", "50")


def test_zip_policy_contains_the_statistics_of_rl_zoo(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yml"
    recipe.write_text(NORMALIZED)
    options = ("--algo", "ppo", "--conf-file", recipe, "--log-folder", tmp_path / "logs")
    run_zoo("train", *options)
    (model,) = tmp_path.glob("logs/ppo/*/acsar_gym-PointGoal-v0.zip")
    assert list(model.parent.glob("*/vecnormalize.pkl"))
    policy = ZipPolicy(model, trust=True, env_id="point_goal")
    runs.make_env(policy, "planar", None, {}).close()

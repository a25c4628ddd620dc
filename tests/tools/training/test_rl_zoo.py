"""RL Zoo itself on our recipes: it trains on the compiled batch, and enjoys the single env.

All of it is slow: RL Zoo takes seconds to import. `make test-ecosystem` has it as well.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from acsar_gym.resources import AGENTS

pytestmark = [pytest.mark.xdist_group(__name__), pytest.mark.slow]

PATIENCE = 300.0
"""For a subprocess on a busy machine [s]."""
ENV = ["--env", "acsar_gym/PointGoal-v0", "--gym-packages", "acsar_gym"]
SMALL = ["--hyperparams", "n_envs:8", "n_steps:16", "batch_size:128"]


def zoo(script: str, *arguments: str | Path) -> str:
    """Run a script of rl_zoo3 and return what it says."""
    command = [sys.executable, "-m", f"rl_zoo3.{script}", *ENV, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_rl_zoo_trains_on_the_batch_and_enjoys(tmp_path: Path) -> None:
    recipe = AGENTS / "recipes" / "ppo.yml"
    given = ("--conf-file", recipe, "-f", tmp_path)
    options = ("-n", "2000", "--eval-episodes", "1")
    said = zoo("train", "--algo", "ppo", *given, *options, "--eval-freq", "1000", *SMALL)
    assert "Using 8 environments" in said
    run = tmp_path / "ppo" / "acsar_gym-PointGoal-v0_1"
    assert (run / "acsar_gym-PointGoal-v0.zip").exists()
    assert (run / "best_model.zip").exists()
    monitors = sorted(path.name for path in run.glob("*.monitor.csv"))
    assert monitors == ["0.monitor.csv"]
    assert len((run / "0.monitor.csv").read_text().splitlines()) >= 2 + 8
    seen = zoo("enjoy", "--algo", "ppo", "-f", tmp_path, "--no-render", "-n", "250")
    assert "Episode Reward" in seen


@pytest.mark.parametrize("algo", ["sac", "tqc", "ppo_lstm"])
def test_rl_zoo_trains_with_the_other_recipes(algo: str, tmp_path: Path) -> None:
    recipe = AGENTS / "recipes" / f"{algo}.yml"
    given = ("--conf-file", recipe, "-f", tmp_path)
    options = ("-n", "2500", "--eval-freq", "-1")
    zoo("train", "--algo", algo, *given, *options, "--hyperparams", "n_envs:8")
    zoo("enjoy", "--algo", algo, "-f", tmp_path, "--no-render", "-n", "50")

"""RL Zoo with a file of a user's own and normalization, and the export of what it saves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import ZipPolicy

CONFIG = """
acsar_gym/PointGoal-v0: {policy: MlpPolicy, n_timesteps: 64, n_envs: 2, normalize: true,
  n_steps: 16, batch_size: 16, env_kwargs: {link: planar}}
"""
COMMAND = (
    "-m rl_zoo3.train --algo ppo --env acsar_gym/PointGoal-v0 --gym-packages acsar_gym "
    "--conf-file mine.yml --log-folder logs"
)


def test_its_zip_and_statistics_become_a_policy(tmp_path: Path) -> None:
    (tmp_path / "mine.yml").write_text(CONFIG)
    subprocess.run([sys.executable, *COMMAND.split()], cwd=tmp_path, check=True, timeout=1800)
    (model,) = tmp_path.glob("logs/ppo/*/acsar_gym-PointGoal-v0.zip")
    assert list(model.parent.glob("*/vecnormalize.pkl"))
    policy = ZipPolicy(model, trust=True, env_id="point_goal")
    runs.make_env(policy, "planar", None, {}).close()

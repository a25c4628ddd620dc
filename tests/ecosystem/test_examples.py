"""agents/examples: each script trains for a few steps, and what it exports drives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy

EXAMPLES = Path(__file__).resolve().parents[2] / "agents" / "examples"
SMALL = ("--steps", "256", "--robots", "8", "--rollout", "16", "--seed", "3")


def run(name: str, folder: Path, *options: str) -> str:
    """Run a script as a user does, and return what it printed."""
    variables = {
        "RAY_AUTH_MODE": "disabled",
        "OMP_NUM_THREADS": "1",
        "MINARI_DATASETS_PATH": str(folder),
    }

    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *options],
        cwd=folder,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("cleanrl_ppo", ("--more", "num-minibatches=4")),
        ("rllib_batch", ("--runners", "1")),
        ("sbx_ppo", ()),
        ("skrl_ppo", ()),
        ("torchrl_ppo", ()),
    ],
)
def test_example_trains_and_its_policy_drives(
    name: str, more: tuple[str, ...], tmp_path: Path
) -> None:
    options = ("--env", "acsar_gym:acsar_gym/PointGoal-v0", "--out", "mine.onnx", *SMALL)
    assert "steps/s" in run(f"{name}.py", tmp_path, *options, *more)
    policy = OnnxPolicy(tmp_path / "mine.onnx")
    assert policy.env_id == "acsar_gym/PointGoal-v0"
    env = runs.make_env(policy, "planar", None, {})
    observation, _ = env.reset(seed=0)
    assert abs(policy(observation)).max() <= 1.0
    env.close()


def test_minari_record_writes_episodes(tmp_path: Path) -> None:
    output = run("minari_record.py", tmp_path, "--steps", "100")
    assert "acsar/point_goal-v0: " in output
    assert (tmp_path / "acsar" / "point_goal-v0" / "data").is_dir()

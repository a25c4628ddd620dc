"""agents/examples: each script trains for a few steps, and what it exports drives."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy

EXAMPLES = Path(__file__).resolve().parents[2] / "agents" / "examples"
SMALL = ("--steps", "256", "--robots", "8", "--rollout", "16", "--seed", "3")


def run(name: str, folder: Path, *options: str) -> str:
    """Run a script in a process of its own, as a user does; returns what it printed."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *options],
        cwd=folder,
        env=os.environ
        | {
            "RAY_AUTH_MODE": "disabled",
            "OMP_NUM_THREADS": "1",
            "MINARI_DATASETS_PATH": str(folder),
        },
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
        ("sb3_ppo", ()),
        ("sbx_ppo", ()),
        ("skrl_ppo", ()),
        ("torchrl_ppo", ()),
    ],
)
def test_it_trains_and_its_export_drives(name: str, more: tuple[str, ...], tmp_path: Path) -> None:
    asked = ("--env", "acsar_gym:acsar_gym/PointGoal-v0", "--out", "mine.onnx")
    said = run(f"{name}.py", tmp_path, *asked, *SMALL, *more)
    assert "steps/s" in said
    policy = OnnxPolicy(tmp_path / "mine.onnx")
    assert policy.env_id == "acsar_gym/PointGoal-v0"
    env = runs.make_env(policy, "planar", None, {})
    observation, _ = env.reset(seed=0)
    assert abs(policy(observation)).max() <= 1.0
    env.close()


def test_minari_has_the_episodes(tmp_path: Path) -> None:
    said = run("minari_record.py", tmp_path, "--steps", "100")
    assert "acsar/point_goal-v0: " in said
    assert (tmp_path / "acsar" / "point_goal-v0" / "data").is_dir()


def test_rllib_takes_the_id_as_it_is(tmp_path: Path) -> None:
    page = (EXAMPLES.parents[1] / "docs" / "training.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    (shown,) = (code for code in blocks if "rllib" in code)
    assert "256" in shown
    code = shown.replace("256", "4") + (
        "config.training(train_batch_size_per_learner=32, minibatch_size=16, num_epochs=1)\n"
        "config.env_runners(num_env_runners=0)\n"
        "print(config.build_algo().train()['env_runners']['num_env_steps_sampled'])\n"
    )
    (tmp_path / "mine.py").write_text(code)
    assert int(float(run(str(tmp_path / "mine.py"), tmp_path).split()[-1])) >= 32

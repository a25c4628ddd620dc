"""README's snippets for large libraries, in an environment of their own: `make test-ecosystem`."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import snippets

from acsar_gym.evaluation import runs
from acsar_gym.policies import OnnxPolicy


def test_rl_zoo_and_the_export_of_what_it_saves(tmp_path: Path) -> None:
    smaller = {"300000, n_envs: 8": "64, n_envs: 2, n_steps: 16, batch_size: 16"}
    snippets.run("RL Zoo", smaller, tmp_path)
    (model,) = tmp_path.glob("logs/ppo/*/acsar_gym-PointGoal-v0.zip")
    (statistics,) = model.parent.glob("*/vecnormalize.pkl")
    out = tmp_path / "policy.onnx"
    runs.export(model, out, "point_goal", None, trust=True, vecnormalize=str(statistics))
    runs.made(OnnxPolicy(out), "planar", None, {}).close()


def test_cleanrl(tmp_path: Path) -> None:
    found = importlib.util.find_spec("cleanrl")
    assert found is not None
    assert found.submodule_search_locations is not None
    script = "ppo_continuous_action.py"
    shutil.copy(Path(found.submodule_search_locations[0]) / script, tmp_path)
    smaller = {"PointGoal-v0": "PointGoal-v0 --total-timesteps 512 --num-steps 256"}
    assert "episodic_return=" in snippets.run("CleanRL", smaller, tmp_path)


def test_rllib(tmp_path: Path) -> None:
    tiny = ".training(train_batch_size_per_learner=100, minibatch_size=50, num_epochs=1)"
    smaller = {"num_env_runners=2).": f"num_env_runners=1){tiny}."}
    assert int(float(snippets.run("RLlib", smaller, tmp_path).split("\n")[0])) >= 100


def test_torchrl(tmp_path: Path) -> None:
    snippets.run("TorchRL", {"1000": "50", "300_000": "100"}, tmp_path)


def test_skrl(tmp_path: Path) -> None:
    snippets.run("skrl", {"256": "8", '"rollouts": 64': '"rollouts": 8', "2000": "16"}, tmp_path)

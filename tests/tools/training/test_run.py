"""`train` with its algorithms, devices and targets."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from acsar_gym.errors import ConfigError
from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy
from acsar_gym.tools.training import seeds

pytestmark = pytest.mark.xdist_group(__name__)

TINY = ["--robots", "8", "--no-progress", "--threads", "1", "--seed", "3"]


@pytest.mark.parametrize("algo", ["sac", "tqc", "ppo_lstm"])
def test_every_algorithm_leaves_a_policy_that_decides_as_its_model(
    algo: str, tmp_path: Path
) -> None:
    recipe = tmp_path / "mine.yml"
    recipe.write_text(yaml.safe_dump({"default": SMALL[algo]}))
    options = ["--algo", algo, "--conf-file", str(recipe), "--out", str(tmp_path)]
    assert seeds.main([*TINY, *options]) == 0
    policy = OnnxPolicy(tmp_path / "policy.onnx")
    saved = ZipPolicy(tmp_path / "model.zip", trust=True)
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 7)).astype(np.float32)
    for _ in range(2):
        actions = [(policy(one), saved(one)) for one in seen]
        for exported, own in actions:
            assert exported == pytest.approx(own, abs=1e-5)
        policy.reset()
        saved.reset()
        assert policy(seen[0]) == pytest.approx(actions[0][0], abs=1e-6)
        policy.reset()
        saved.reset()
    assert (policy(seen[1]) == policy(seen[1])).all() == (algo != "ppo_lstm")


LITTLE = {"n_timesteps": 64, "n_envs": 4, "policy_kwargs": {"net_arch": [8]}}
SMALL = {
    "sac": LITTLE | {"learning_starts": 8},
    "tqc": LITTLE | {"learning_starts": 8, "policy_kwargs": {"net_arch": [8], "n_quantiles": 5}},
    "ppo_lstm": LITTLE
    | {"policy": "MlpLstmPolicy", "n_steps": 16, "batch_size": 32, "n_epochs": 1}
    | {"policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 8}},
}


def test_a_target_ends_the_training_with_the_policy_that_reached_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--steps", "100000", "--target", "0", "--out", str(tmp_path)]
    assert seeds.main([*TINY, *options]) == 0
    said = capsys.readouterr().out
    assert " of 512 episodes (" in said
    assert "target of 0.0% reached at 256 steps" in said
    with (tmp_path / "learning_curve.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["steps"] == "256"
    config = yaml.safe_load((tmp_path / "config.yml").read_text())
    assert config["run"]["held_out"]["success_rate"] == float(row["success_rate"])


def test_where_there_is_no_cuda_it_says_so(tmp_path: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is CUDA here")
    with pytest.raises(ConfigError, match=r"--device cuda: torch .* leave --device away"):
        seeds.main([*TINY, "--device", "cuda", "--out", str(tmp_path)])

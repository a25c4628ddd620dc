"""From a stable-baselines3 model to a file that drives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
from onnx_tools import ENV_ID, GOOD, Maker, relabelled

from acsar_gym.errors import PolicyError
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import summarise_episodes
from acsar_gym.tools.policies import OnnxPolicy, save

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.mark.parametrize("link", ["bullet", "planar"])
def test_the_policy_that_comes_along_reaches_its_goals(link: str) -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link)
    summary = summarise_episodes(list(run_episodes(env, OnnxPolicy("point_goal"), 20, seed=500)))
    env.close()
    assert summary.success_rate >= 0.95
    assert 0.0 < summary.odometry_error < 0.05
    assert summary.late_ticks == 0


def test_driving_needs_no_torch() -> None:
    code = (
        "import sys, numpy as np; from acsar_gym.tools.policies import OnnxPolicy;"
        "OnnxPolicy('point_goal')(np.zeros(7, np.float32));"
        "sys.exit('torch' in sys.modules or 'pybullet' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_a_file_cannot_have_a_module_imported(tmp_path: Path) -> None:
    path = relabelled(tmp_path / "module.onnx", env__id=f"some_module:{ENV_ID}")
    with pytest.raises(PolicyError, match=r"env\.id = "):
        OnnxPolicy(path)


def test_a_network_with_other_names_is_refused(tmp_path: Path) -> None:
    make = Maker()
    make.dense("observation", 7)
    path = tmp_path / "renamed.onnx"
    in_the_graph = b"\n\x0bobservation"  # a string of protobuf's; the bundle is JSON
    path.write_bytes(make.bytes().replace(in_the_graph, b"\n\x0bobservatiom"))
    with pytest.raises(PolicyError, match="must map 'observation' to 'action'"):
        OnnxPolicy(path)


def test_the_file_names_no_path_of_the_machine_that_trained(tmp_path: Path) -> None:
    import torch

    save(torch.nn.Linear(7, 2), "point_goal", tmp_path / "policy.onnx")
    for path in (tmp_path / "policy.onnx", GOOD):
        content = path.read_bytes()
        assert b".py" not in content
        assert str(Path.home()).encode() not in content


def test_onnxruntime_keeps_no_id_of_this_computer(tmp_path: Path) -> None:
    silent = ("CI", "GITHUB_ACTIONS", "TF_BUILD", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    user = {name: value for name, value in os.environ.items() if name not in silent}
    decide = "from acsar_gym.tools.policies import OnnxPolicy; OnnxPolicy('point_goal').reset()"
    command = [sys.executable, "-c", decide]
    subprocess.run(command, check=True, env=user | {"HOME": str(tmp_path)}, timeout=120)
    assert list(tmp_path.rglob("*")) == []

"""Policy files: good ones, recurrent ones, and those that an attacker would send."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from policy_tools import ENV_ID, GOOD, HOSTILE, counting, dense, network, relabelled

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import summarise_episodes
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.policies.onnx import MAX_POLICY_BYTES

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.mark.parametrize("link", ["bullet", "planar"])
def test_packaged_policy_reaches_its_goals(link: str) -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link)
    summary = summarise_episodes(list(run_episodes(env, OnnxPolicy("point_goal"), 20, seed=500)))
    env.close()
    assert summary.success_rate >= 0.95
    assert 0.0 < summary.odometry_error < 0.05
    assert summary.late_ticks == 0


def test_pickle_contains_the_file(tmp_path: Path) -> None:
    path = counting(tmp_path / "p.onnx")
    policy = OnnxPolicy(path)
    path.unlink()
    copy = pickle.loads(pickle.dumps(policy))  # noqa: S301 - of this test
    zeros = np.zeros(7, np.float32)
    assert (copy(zeros) == policy(zeros)).all()
    assert copy.about == policy.about
    packaged = pickle.loads(pickle.dumps(OnnxPolicy("point_goal")))  # noqa: S301
    assert packaged.act_many(zeros[None]).shape == (1, 2)


def test_reset_clears_the_states(tmp_path: Path) -> None:
    policy = OnnxPolicy(counting(tmp_path / "p.onnx"))
    zeros = np.zeros(7, np.float32)
    for _ in range(2):
        policy.reset()
        turns = [float(policy(zeros)[1]) for _ in range(3)]
        assert turns == pytest.approx([0.0, 0.1, 0.2])
    done = runs.evaluate_policy(policy, "planar", None, range(2))
    assert [episode.length > 0 for episode in done.results] == [True, True]


@pytest.mark.parametrize(
    "options",
    [{"state": "float[n,2]"}, {"state": "float[50000,50000]"}, {"outputs": 0}],
    ids=["free", "huge", "lost"],
)
def test_onnx_policy_refuses_states(options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"p\.onnx: "):
        OnnxPolicy(counting(tmp_path / "p.onnx", **options))


def refused(path: Path) -> str:
    """The one line with which a policy file is refused."""
    with pytest.raises(PolicyError) as raised:
        runs.make_env(runs.load_policy(str(path), trust=False), "planar", None, {})
    message = str(raised.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert len(message) < 450
    return message


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__)
def test_onnx_policy_refuses_hostile_files_in_one_line(
    make: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("weights.bin").write_bytes(bytes(56))  # what external data would be taken from
    path = tmp_path / "policy.onnx"
    path.write_bytes(make().SerializeToString())
    refused(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PK", "isn't an ONNX file but a zip"),
        (b"\x18\x00\x00\x00ORTM" + bytes(100), "isn't a whole ONNX file"),  # onnxruntime's own
        (GOOD.read_bytes()[:900], "isn't a whole ONNX file"),
    ],
    ids=["zip", "format", "cut"],
)
def test_onnx_policy_names_other_files(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(content)
    assert refused(path).startswith(f"{path}: {message}")


def test_onnx_policy_reads_no_devices_pipes_and_large_files(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.onnx"
    large = tmp_path / "large.onnx"
    os.mkfifo(pipe)
    with large.open("wb") as file:
        file.truncate(MAX_POLICY_BYTES + 1)
    assert "regular file" in refused(pipe)
    assert "larger than 32 MB" in refused(large)


@pytest.mark.parametrize("env_id", ["phys2d/CartPole-v1", "CartPole-v1"])
def test_load_policy_lets_files_choose_only_envs_of_this_package(
    env_id: str, tmp_path: Path
) -> None:
    path = relabelled(tmp_path / "other.onnx", env=env_id)
    assert "--env" in refused(path)
    policy = runs.load_policy(str(path), trust=False, env=ENV_ID)
    runs.make_env(policy, "planar", None, {}).close()
    with pytest.raises(ConfigError, match="no_such_module"):
        runs.load_policy(str(path), trust=False, env="no_such_module:x-v0")
    for hostile_id in (f"some_module:{ENV_ID}", "\x1b[2Jx"):
        assert "\x1b" not in refused(relabelled(path, env=hostile_id))


def test_onnx_policy_refuses_other_names(tmp_path: Path) -> None:
    content = network(dense("action")).SerializeToString()
    path = tmp_path / "renamed.onnx"
    in_the_graph = b"\n\x0bobservation"  # a string of protobuf
    path.write_bytes(content.replace(in_the_graph, b"\n\x0bobservatiom"))
    assert "must map 'observation' to 'action'" in refused(path)


def test_driving_imports_no_torch_and_stores_no_id_of_this_computer(
    tmp_path: Path,
) -> None:
    silent = ("CI", "GITHUB_ACTIONS", "TF_BUILD", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    user = {name: value for name, value in os.environ.items() if name not in silent}
    code = (
        "import sys, numpy as np; from acsar_gym.tools.policies import OnnxPolicy;"
        "OnnxPolicy('point_goal')(np.zeros(7, np.float32));"
        "sys.exit('torch' in sys.modules or 'pybullet' in sys.modules)"
    )
    command = [sys.executable, "-c", code]
    subprocess.run(command, check=True, env=user | {"HOME": str(tmp_path)}, timeout=120)
    assert list(tmp_path.rglob("*")) == []

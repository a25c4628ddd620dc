"""Torch modules of any library become files that drive."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools import policies
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy, save

pytestmark = pytest.mark.xdist_group(__name__)
OBSERVATIONS = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 7)).astype(np.float32)


def make_network(*, outputs: int = 2, dropout: float = 0.0) -> Any:
    import torch

    torch.manual_seed(0)
    layers = [torch.nn.Linear(7, 8), torch.nn.Tanh(), torch.nn.Dropout(dropout)]
    return torch.nn.Sequential(*layers, torch.nn.Linear(8, outputs))


@pytest.mark.parametrize("clip", [2.0, None])
def test_save_keeps_the_decisions_with_normalizer_and_without_dropout(
    clip: float | None, tmp_path: Path
) -> None:
    import torch

    path = tmp_path / "policy.onnx"
    network = make_network(dropout=0.5)
    network[0].eval()
    mean = np.linspace(-1.0, 1.0, 7)
    std = np.linspace(0.1, 2.0, 7)
    adapted = policies.actor(network, lambda net, seen: net(seen)) if clip else network
    save(adapted, "point_goal", path, normalizer=[mean, std, clip])
    assert [layer.training for layer in network] == [False, True, True, True]

    network.eval()
    content = path.read_bytes()  # no paths of this machine
    assert b".py" not in content
    assert str(Path.home()).encode() not in content
    policy = OnnxPolicy(path)
    limit = clip or np.inf
    for observation in OBSERVATIONS:
        normalized = np.clip((observation - mean) / std, -limit, limit).astype(np.float32)
        with torch.no_grad():
            expected = network(torch.from_numpy(normalized)[None])[0].clamp(-1.0, 1.0)
        assert policy(observation) == pytest.approx(expected.numpy(), abs=1e-6)
    runs.make_env(policy, "planar", None, {}).close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"outputs": 3}, "(1, 3)"),
        ({"env_id": "path_follow"}, "(batch, 18)"),
        ({"normalizer": (0.0, 0.0, None)}, "std"),
        ({"normalizer": (0.0, np.inf, None)}, "std"),
        ({"normalizer": (np.zeros(5), 1.0, None)}, "doesn't take observations"),
        ({"normalizer": [0.0]}, "normalizer: must be (mean, std)"),
        ({"goals": 1}, "goals"),
        ({"env_id": "gymnasium:Pendulum-v1"}, "Pendulum"),
        ({"weight": np.inf}, "weights contain NaN or infinity"),
    ],
    ids=str,
)
def test_save_refuses_in_one_line(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    options = {"env_id": "point_goal", **options}
    network = make_network(outputs=options.pop("outputs", 2))
    network[-1].bias.data[0] = options.pop("weight", 0.0)
    path = tmp_path / "policy.onnx"
    with pytest.raises((ConfigError, PolicyError)) as raised:
        save(network, path=path, **options)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not path.exists()


def test_save_stores_scale_and_rate_of_the_env(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    options: dict[str, Any] = {"goal_distance": (0.5, 10.0), "policy_rate": 20.0}
    save(make_network(), "point_goal", path, **options)
    policy = OnnxPolicy(path)
    assert (policy.scale, policy.document.rate) == (10.0, 20.0)
    runs.make_env(policy, "planar", None, options).close()


def test_importing_policies_imports_no_torch_and_training_no_onnx() -> None:
    for module, absent in (
        ("acsar_gym.tools.policies", "{'torch', 'onnxruntime', 'onnx', 'pybullet'}"),
        ("acsar_gym.tools.policies.sb3", "{'onnx', 'onnxscript', 'onnxruntime'}"),
    ):
        code = f"import sys, {module}; sys.exit(sorted({absent} & set(sys.modules)) or 0)"
        done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
        assert done.returncode == 0, (module, done.stderr)

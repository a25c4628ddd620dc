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
ID = "acsar_gym/PointGoal-v0"
SEEN = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 7)).astype(np.float32)


def network(*, outputs: int = 2, dropout: float = 0.0) -> Any:
    import torch

    torch.manual_seed(0)
    layers = [torch.nn.Linear(7, 8), torch.nn.Tanh(), torch.nn.Dropout(dropout)]
    return torch.nn.Sequential(*layers, torch.nn.Linear(8, outputs))


@pytest.mark.parametrize("clip", [2.0, None])
def test_a_module_decides_the_same_from_its_file(clip: float | None, tmp_path: Path) -> None:
    """With its normalizer, without its dropout, and what is beyond the limits is clipped."""
    import torch

    module, path = network(dropout=0.5), tmp_path / "policy.onnx"
    module.train()
    mean, std = np.linspace(-1.0, 1.0, 7), np.linspace(0.1, 2.0, 7)
    save(module, "point_goal", path, normalizer=[mean, std, clip])
    assert module.training
    assert module[2].training
    module.eval()
    policy = OnnxPolicy(path)
    for seen in SEEN:
        most = np.inf if clip is None else clip
        normalized = np.clip((seen - mean) / std, -most, most).astype(np.float32)
        with torch.no_grad():
            expected = module(torch.from_numpy(normalized)[None])[0].clamp(-1.0, 1.0)
        assert policy(seen) == pytest.approx(expected.numpy(), abs=1e-6)
    runs.make_env(policy, "planar", None, {}).close()


def test_a_network_that_is_called_in_its_own_way_decides_the_same(tmp_path: Path) -> None:
    import torch

    class Foreign(torch.nn.Linear):
        def decide(self, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
            action, deviation = self(batch["seen"]).split(2, dim=1)
            return action, deviation

    foreign, path = Foreign(7, 4), tmp_path / "policy.onnx"
    save(policies.actor(foreign, lambda net, seen: net.decide({"seen": seen})[0].tanh()), ID, path)
    with torch.no_grad():
        expected = foreign.decide({"seen": torch.from_numpy(SEEN[:1])})[0].tanh()[0]
    assert OnnxPolicy(path)(SEEN[0]) == pytest.approx(expected.numpy(), abs=1e-6)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outputs": 3}, "(1, 3)"),
        ({"env_id": "path_follow"}, "(batch, 18)"),
        ({"normalizer": (0.0, 0.0, None)}, "std"),
        ({"normalizer": (np.nan, 1.0, None)}, "normalizer: mean"),
        ({"normalizer": (np.zeros(5), 1.0, None)}, "doesn't take observations"),
        ({"normalizer": [0.0]}, "normalizer: must be (mean, std)"),
        ({"normalizer": 3}, "normalizer: must be (mean, std)"),
        ({"normalizer": ("a", 1.0)}, "normalizer: mean"),
        ({"normalizer": (0.0, 1.0, "a")}, "std and clip must be finite"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_does_not_fit_is_one_line(options: dict[str, Any], said: str, tmp_path: Path) -> None:
    module = network(outputs=options.get("outputs", 2))
    env_id = options.get("env_id", "acsar_gym/PointGoal-v0")
    with pytest.raises(PolicyError) as raised:
        save(module, env_id, tmp_path / "p.onnx", normalizer=options.get("normalizer"))
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "p.onnx").exists()


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(broken: float, tmp_path: Path) -> None:
    module = network()
    list(module.parameters())[-1].data.flatten()[0] = broken
    with pytest.raises(
        PolicyError, match=r"weights network\.\d\.(weight|bias) contain NaN"
    ) as raised:
        save(module, "point_goal", tmp_path / "p.onnx")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "p.onnx").exists()


def test_a_file_keeps_what_the_envs_arguments_scale(tmp_path: Path) -> None:
    """The signatures are the same."""
    path = tmp_path / "far.onnx"
    far: dict[str, Any] = {"goal_distance": (0.5, 10.0)}
    save(network(), "point_goal", path, policy_rate=20.0, **far)
    policy = OnnxPolicy(path)
    assert (policy.scale, policy.document.rate) == (10.0, 20.0)
    with pytest.raises(PolicyError, match=r"scale is 10 in the file and 3 in .*: give"):
        runs.make_env(policy, "planar", None, {})
    env: Any = runs.make_env(policy, "planar", None, far | {"policy_rate": 20.0}).unwrapped
    policy.check(env.task, env.sensors, policy_rate=20.0)
    with pytest.raises(PolicyError, match=r"rate is 20 in the file and 10 in .*: give"):
        policy.check(env.task, env.sensors, policy_rate=10.0)
    packaged = OnnxPolicy("point_goal")
    runs.make_env(packaged, "planar", None, far | {"distance_scale": 3.0}).close()


def test_what_an_environment_does_not_take_is_one_line(tmp_path: Path) -> None:
    for env_id, options, named in (
        ("point_goal", {"goals": 1}, "goals"),
        ("point_goal", {"link": "planar"}, "link"),
        ("no_such_module:Maze-v0", {}, "no_such_module"),
        ("gymnasium:Pendulum-v1", {}, "Pendulum"),
    ):
        with pytest.raises(ConfigError, match=named) as raised:
            save(network(), env_id, tmp_path / "p.onnx", **options)
        assert "\n" not in str(raised.value)


def test_importing_policies_imports_no_torch_and_training_no_onnx() -> None:
    for module, absent in (
        ("acsar_gym.tools.policies", "{'torch', 'onnxruntime', 'onnx', 'pybullet'}"),
        ("acsar_gym.tools.policies.sb3", "{'onnx', 'onnxscript', 'onnxruntime'}"),
    ):
        code = f"import sys, {module}; sys.exit(sorted({absent} & set(sys.modules)) or 0)"
        done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
        assert done.returncode == 0, (module, done.stderr)

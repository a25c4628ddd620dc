"""Zips of stable-baselines3, good ones and bad ones."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.tools.policies.document import describe_policy

NAMES = ("PPO", "A2C", "SAC", "TD3", "DDPG")
PLACES = ("data", "policy.pth", "pytorch_variables.pth", "policy.optimizer.pth")
"""What stable-baselines3 unpickles, or gives to torch to unpickle."""


def algorithms() -> dict[str, Any]:
    """stable-baselines3's classes by their names. Importing them takes seconds."""
    import stable_baselines3

    return {name: getattr(stable_baselines3, name) for name in NAMES}


def save(
    path: Path,
    algorithm: str = "PPO",
    env_id: str = "acsar_gym/PointGoal-v0",
    *,
    label: bool = True,
    net: dict[str, Any] | None = None,
    **options: Any,
) -> Path:
    """A small model with random weights: untrained ones have actions that are all about zero."""
    from acsar_gym.tools.policies import sb3_export

    options["policy_kwargs"] = {"net_arch": [8]} | (net or {})
    env = gymnasium.make(env_id, link="planar")
    model = algorithms()[algorithm]("MlpPolicy", env, device="cpu", seed=0, **options)
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.4)
    inner = env.unwrapped
    assert isinstance(inner, RobotEnv)
    if label:
        sb3_export.label(model, describe_policy(inner, inner.task.id))
    model.save(path)
    env.close()
    return path


class _Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.marker}",)


def poison(good: Path, place: str, marker: Path, path: Path) -> Path:
    """A copy of a zip that touches `marker` when that place in it is unpickled."""
    payload = pickle.dumps(_Payload(marker))
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == place:
                content = _data(content, payload) if name == "data" else payload
            target.writestr(name, content)
    return path


def _data(content: bytes, payload: bytes) -> bytes:
    data = json.loads(content)
    for item in data.values():
        if isinstance(item, dict) and ":serialized:" in item:
            item[":serialized:"] = base64.b64encode(payload).decode()
    return json.dumps(data).encode()

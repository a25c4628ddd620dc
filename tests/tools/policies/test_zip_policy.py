"""Zips of stable-baselines3: nothing without trust, and the model's own actions with it."""

from __future__ import annotations

import hashlib
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_tools import NAMES, PLACES, algorithms, poison, save

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """PPO's zip for PointGoal."""
    return save(tmp_path_factory.mktemp("zip") / "model.zip")


def refused(path: Path, **options: Any) -> str:
    """The one line with which a trusted zip is refused."""
    with pytest.raises(PolicyError) as raised:
        ZipPolicy(path, trust=True, **options)
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)
    return str(raised.value)


@pytest.mark.parametrize(
    ("place", "name"), [*((place, "model.zip") for place in PLACES), ("data", "model.onnx")]
)
def test_zip_policy_runs_nothing_without_trust(
    place: str, name: str, good: Path, tmp_path: Path
) -> None:
    marker = tmp_path / "marker"
    bad = poison(good, place, marker, tmp_path / name)
    with pytest.raises(PolicyError, match=name):
        runs.load_policy(str(bad), trust=False)
    with pytest.raises(PolicyError, match="--trust"):
        ZipPolicy(bad)
    assert not marker.exists()


@pytest.mark.parametrize("algorithm", NAMES)
def test_zip_policy_decides_as_the_model_and_so_do_copies(algorithm: str, tmp_path: Path) -> None:
    options: dict[str, Any] = {} if algorithm in {"PPO", "A2C"} else {"buffer_size": 10}
    path = save(tmp_path / "model.zip", algorithm, **options)
    model = algorithms()[algorithm].load(path, device="cpu")
    policy = ZipPolicy(path, trust=True)
    assert policy.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert policy.env_id == "acsar_gym/PointGoal-v0"
    runs.make_env(policy, "planar", None, {}).close()

    policy.save(tmp_path / "policy.onnx")
    path.unlink()
    copies = (OnnxPolicy(tmp_path / "policy.onnx"), pickle.loads(pickle.dumps(policy)))  # noqa: S301
    assert copies[1].sha256 == policy.sha256
    actions = []
    for observation in np.random.default_rng(0).uniform(-1.0, 1.0, (50, 7)).astype(np.float32):
        action = policy(observation)
        assert action.shape == (2,)
        assert action.dtype == np.float32
        expected, _ = model.predict(observation, deterministic=True)
        assert action == pytest.approx(expected, abs=1e-6)
        assert all((copy(observation) == action).all() for copy in copies)
        actions.append(action)
    assert np.abs(actions).max() <= 1.0
    assert np.std(actions, axis=0).min() > 0.05


def test_zip_policy_without_a_label_needs_an_env(tmp_path: Path) -> None:
    path = save(tmp_path / "model.zip", label=False)
    assert "add --env point_goal" in refused(path)
    policy = ZipPolicy(path, trust=True, env_id="point_goal")
    assert policy.document.env == "acsar_gym/PointGoal-v0"
    assert "made for Box(" in refused(path, env_id="path_follow")
    with pytest.raises(ConfigError, match="Maze"):
        ZipPolicy(path, trust=True, env_id="maze")


def test_zip_policy_refuses_other_files_in_one_line(good: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.zip").write_bytes(good.read_bytes()[:-200])
    os.mkfifo(tmp_path / "pipe.zip")  # which would be waited for
    for name in ("cut", "pipe", "missing"):
        refused(tmp_path / f"{name}.zip")


def test_zip_policy_refuses_other_algorithms_actions_and_observations(tmp_path: Path) -> None:
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.vec_env import VecFrameStack

    from acsar_gym.tools.policies.sb3 import make_batch

    path = tmp_path / "model.zip"
    DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu").save(path)
    assert "and Discrete(2): a policy of this package" in refused(path, env_id="point_goal")
    PPO("MlpPolicy", "Pendulum-v1", device="cpu").save(path)
    assert "and Box(-2.0, 2.0, (1,)" in refused(path, env_id="point_goal")
    env = VecFrameStack(make_batch("point_goal", 1), 3)
    PPO("MlpPolicy", env, device="cpu").save(path)
    env.close()
    assert "only VecNormalize" in refused(path, env_id="point_goal")


def normalized(folder: Path, algorithm: str = "PPO", **options: Any) -> tuple[Path, Any, Any]:
    """A model trained with VecNormalize as RL Zoo saves it, the model, and its normalizer."""
    from stable_baselines3.common.vec_env import VecNormalize

    from acsar_gym.tools.policies.sb3 import make_batch

    env = VecNormalize(make_batch("point_goal", 4), clip_obs=2.0, **options)
    some: dict[str, Any] = (
        {"n_steps": 16, "batch_size": 64} if algorithm == "PPO" else {"buffer_size": 100}
    )
    some["policy_kwargs"] = {"net_arch": [8]}
    model = algorithms()[algorithm]("MlpPolicy", env, device="cpu", seed=0, **some).learn(64)
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.4)
    model.save(folder / "model.zip")
    env.save(str(folder / "vecnormalize.pkl"))
    env.close()
    return folder / "model.zip", model, env


def test_zip_policy_contains_the_statistics_of_vecnormalize(tmp_path: Path) -> None:
    path, model, env = normalized(tmp_path)
    policies = [ZipPolicy(path, trust=True, env_id="point_goal")]
    beside = (tmp_path / "vecnormalize.pkl").rename(tmp_path / "statistics")
    assert "was trained with a VecNormalize, whose file" in refused(path, env_id="point_goal")
    policies += [
        ZipPolicy(path, trust=True, env_id="point_goal", vecnormalize=named)
        for named in (beside, "none")
    ]

    for number in (1, 2):  # as those of checkpoints
        (tmp_path / f"rl_model_vecnormalize_{number}_steps.pkl").touch()
    assert "_1_steps.pkl, and 1 more is beside it: " in refused(path, env_id="point_goal")
    for file in tmp_path.glob("rl_model*"):
        file.unlink()

    for observation in np.random.default_rng(0).uniform(-2.0, 2.0, (20, 7)).astype(np.float32):
        expected, _ = model.predict(env.normalize_obs(observation), deterministic=True)
        plain, _ = model.predict(observation, deterministic=True)
        for policy, action in zip(policies, (expected, expected, plain), strict=True):
            assert policy(observation) == pytest.approx(action, abs=1e-5)
    # A model that was loaded and saved again doesn't show what it was trained with.
    beside.rename(tmp_path / "vecnormalize.pkl")
    model._last_obs = None
    model.save(path)
    assert "vecnormalize.pkl is beside it: if it was trained" in refused(path, env_id="point_goal")
    bad = tmp_path / "other.pkl"
    bad.write_bytes(pickle.dumps({"a": 1}))
    for file, message in ((bad, "contains a dict, not a VecNormalize"), (path, "not a VecNorm")):
        assert message in refused(path, env_id="point_goal", vecnormalize=file)


@pytest.mark.parametrize("norm_obs", [False, True])
def test_zip_policy_notices_vecnormalize_of_sac(norm_obs: bool, tmp_path: Path) -> None:
    """SAC also saves an original observation without one."""
    path, *_ = normalized(tmp_path, "SAC", norm_obs=norm_obs)
    (tmp_path / "vecnormalize.pkl").unlink()
    if norm_obs:
        assert "was trained with a VecNormalize" in refused(path, env_id="point_goal")
    else:
        ZipPolicy(path, trust=True, env_id="point_goal")


def test_zip_policy_squashes_the_actions_of_a_recurrent_model(tmp_path: Path) -> None:
    from sb3_contrib import RecurrentPPO

    from acsar_gym.tools.policies.sb3 import make_batch

    kwargs = {"squash_output": True, "net_arch": [8], "lstm_hidden_size": 8}
    env = make_batch("point_goal", 1)
    model = RecurrentPPO("MlpLstmPolicy", env, use_sde=True, device="cpu", policy_kwargs=kwargs)
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.8)
    model.save(tmp_path / "model.zip")
    env.close()

    policy = ZipPolicy(tmp_path / "model.zip", trust=True, env_id="point_goal")
    observation = np.full(7, 0.5, np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    assert policy(observation) == pytest.approx(expected, abs=1e-5)

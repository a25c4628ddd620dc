"""Zips of stable-baselines3: nothing without trust, and the model's own actions with it."""

from __future__ import annotations

import hashlib
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zip_tools import NAMES, PLACES, algorithms, poison, save

from acsar_gym.errors import AcsarError, ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import FilePolicy, OnnxPolicy, ZipPolicy
from acsar_gym.tools.training import seeds

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """PPO's zip for PointGoal."""
    return save(tmp_path_factory.mktemp("zip") / "model.zip")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", ["model.zip", "model.onnx"])
def test_nothing_in_a_zip_runs_without_trust(
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
def test_it_decides_as_the_model_does_and_so_does_its_export(
    algorithm: str, tmp_path: Path
) -> None:
    options: dict[str, Any] = {} if algorithm in {"PPO", "A2C"} else {"buffer_size": 10}
    path, out = save(tmp_path / "model.zip", algorithm, **options), tmp_path / "policy.onnx"
    model = algorithms()[algorithm].load(path, device="cpu")
    policy = ZipPolicy(path, trust=True)
    assert policy.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    exported: FilePolicy = policy
    if algorithm in {"PPO", "SAC", "TD3"}:  # A2C and DDPG have the same actors as two of them
        runs.export_policy(path, out, "", None, trust=True)
        exported = OnnxPolicy(out)
    assert (exported.env_id, exported.bundle) == (policy.env_id, policy.bundle)
    seen = []
    for observation in np.random.default_rng(0).uniform(-1.0, 1.0, (50, 7)).astype(np.float32):
        action = policy(observation)
        assert action.shape == (2,)
        assert action.dtype == np.float32
        assert (action == model.predict(observation, deterministic=True)[0]).all()
        assert exported(observation) == pytest.approx(action, abs=1e-6)
        seen.append(action)
    assert np.abs(seen).max() <= 1.0
    assert np.std(seen, axis=0).min() > 0.05


def test_an_unlabelled_zip_needs_to_be_told_its_environment(tmp_path: Path) -> None:
    path, out = save(tmp_path / "model.zip", label=False), tmp_path / "policy.onnx"
    with pytest.raises(PolicyError, match="--env"):
        runs.make_env(ZipPolicy(path, trust=True), "planar", None, {})
    runs.export_policy(path, out, "point_goal", None, trust=True)
    assert OnnxPolicy(out).env_id == "acsar_gym/PointGoal-v0"
    with pytest.raises(PolicyError, match=r"Box.*\(7,\).*\(18,\)"):
        runs.export_policy(path, out, "path_follow", None, trust=True)
    with pytest.raises(ConfigError, match="Maze"):
        runs.export_policy(path, out, "maze", None, trust=True)


def test_what_is_no_whole_zip_says_so_in_one_line(good: Path, tmp_path: Path) -> None:
    contents = {"empty": b"", "text": b"not a zip", "cut": good.read_bytes()[:-200]}
    for name, content in contents.items():
        (tmp_path / f"{name}.zip").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", bytes(51_000_000))
    (tmp_path / "folder.zip").mkdir()
    os.mkfifo(tmp_path / "pipe.zip")  # which would be waited for
    for name in (*contents, "bomb", "folder", "pipe", "missing"):
        with pytest.raises(PolicyError, match=rf"{name}\.zip") as raised:
            ZipPolicy(tmp_path / f"{name}.zip", trust=True)
        assert "\n" not in str(raised.value)


def test_other_algorithms_and_actions_are_refused(tmp_path: Path) -> None:
    from stable_baselines3 import DQN, PPO

    DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu").save(tmp_path / "dqn.zip")
    with pytest.raises(PolicyError, match="not one of PPO, A2C"):
        ZipPolicy(tmp_path / "dqn.zip", trust=True)
    path, out = tmp_path / "ppo.zip", tmp_path / "p.onnx"
    PPO("MlpPolicy", "Pendulum-v1", device="cpu").save(path)
    with pytest.raises(PolicyError, match=r"Box\(-2\.0"):
        runs.export_policy(path, out, "point_goal", None, trust=True)


def normalized(folder: Path) -> tuple[Path, Any, Any]:
    """A model trained with VecNormalize as RL Zoo saves it, the model, and its normalizer."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from acsar_gym.tools.policies.sb3 import make_batch

    env = VecNormalize(make_batch("point_goal", 4), clip_obs=2.0)
    options: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 16, "batch_size": 64}
    model = PPO("MlpPolicy", env, device="cpu", seed=0, **options).learn(64)
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.4)
    model.save(folder / "model.zip")
    env.save(str(folder / "vecnormalize.pkl"))
    env.close()
    return folder / "model.zip", model, env


def test_statistics_of_vecnormalize_become_part_of_the_file(tmp_path: Path) -> None:
    path, model, env = normalized(tmp_path)
    out, beside = tmp_path / "policy.onnx", tmp_path / "vecnormalize.pkl"
    with pytest.raises(PolicyError, match=r"vecnormalize\.pkl is beside it.*--vecnormalize none"):
        runs.export_policy(path, out, "point_goal", None, trust=True)
    with pytest.raises(PolicyError, match=r"vecnormalize\.pkl is beside it"):
        runs.load_policy(str(path), trust=True)
    assert not out.exists()
    runs.export_policy(path, out, "point_goal", None, trust=True, vecnormalize=str(beside))
    policy = OnnxPolicy(out)
    for seen in np.random.default_rng(0).uniform(-2.0, 2.0, (20, 7)).astype(np.float32):
        expected, _ = model.predict(env.normalize_obs(seen), deterministic=True)
        assert policy(seen) == pytest.approx(expected, abs=1e-5)
    bad = tmp_path / "other.pkl"
    bad.write_bytes(pickle.dumps({"a": 1}))
    for file, said in ((bad, "holds a dict, not a VecNormalize"), (path, "not a VecNormalize")):
        with pytest.raises(PolicyError, match=said):
            runs.export_policy(path, out, "point_goal", None, trust=True, vecnormalize=str(file))


def test_a_model_of_vecnormalize_without_its_file_is_refused(tmp_path: Path) -> None:
    path, *_ = normalized(tmp_path)
    out, beside = tmp_path / "policy.onnx", tmp_path / "vecnormalize.pkl"
    elsewhere = beside.rename(tmp_path / "statistics")
    for attempt in (
        lambda: runs.export_policy(path, out, "point_goal", None, trust=True),
        lambda: runs.load_policy(str(path), trust=True),
    ):
        with pytest.raises(PolicyError, match="was trained with a VecNormalize, whose file") as no:
            attempt()
        assert "\n" not in str(no.value)
    assert not out.exists()
    for named in (str(elsewhere), "none"):
        runs.export_policy(path, out, "point_goal", None, trust=True, vecnormalize=named)


def test_a_vecnormalize_is_seen_in_the_zip_itself(tmp_path: Path) -> None:
    """SAC saves an original observation without one, too."""
    from stable_baselines3.common.vec_env import VecNormalize

    from acsar_gym.tools.policies.sb3 import make_batch

    out, path = tmp_path / "policy.onnx", tmp_path / "model.zip"
    options: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 100, "seed": 0}
    for normalizer in (None, "rewards", "observations"):
        env: Any = make_batch("point_goal", 4)
        if normalizer is not None:
            env = VecNormalize(env, norm_obs=normalizer == "observations")
        algorithms()["SAC"]("MlpPolicy", env, device="cpu", **options).learn(20).save(path)
        env.close()
        if normalizer == "observations":
            with pytest.raises(PolicyError, match="was trained with a VecNormalize, whose file"):
                runs.export_policy(path, out, "point_goal", None, trust=True)
        else:
            runs.export_policy(path, out, "point_goal", None, trust=True)
            runs.load_policy(str(path), trust=True, env="point_goal")


def test_a_dict_of_observations_is_refused_in_one_line(tmp_path: Path) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.envs import SimpleMultiObsEnv

    path = tmp_path / "dict.zip"
    PPO("MultiInputPolicy", SimpleMultiObsEnv(discrete_actions=False), device="cpu").save(path)
    for attempt in (
        lambda: runs.load_policy(str(path), trust=True, env="point_goal"),
        lambda: runs.export_policy(path, tmp_path / "p.onnx", "point_goal", None, trust=True),
    ):
        with pytest.raises(PolicyError, match=r"observations that are a Dict of img, vec") as no:
            attempt()
        assert "\n" not in str(no.value)
        assert len(str(no.value)) - len(str(path)) < 250


@pytest.mark.parametrize(
    ("algorithm", "normalizer"),
    [
        ("PPO", "around"),
        *(pytest.param("RecurrentPPO", name, marks=pytest.mark.slow) for name in ("", "inside")),
    ],
)
def test_a_frame_stack_becomes_part_of_the_file(
    algorithm: str, normalizer: str, tmp_path: Path
) -> None:
    """With VecNormalize inside or around it; two episodes, as the training's wrappers have them."""
    from sb3_contrib import RecurrentPPO
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

    from acsar_gym.tools.policies.sb3 import make_batch

    env: Any = make_batch("point_goal", 1)
    env = VecNormalize(env, clip_obs=1.5) if normalizer == "inside" else env
    env = frames = VecFrameStack(env, 3)
    env = VecNormalize(env, clip_obs=1.5) if normalizer == "around" else env
    recurrent = algorithm == "RecurrentPPO"
    kind: Any = RecurrentPPO if recurrent else PPO
    net: dict[str, Any] = {"net_arch": [8], **({"lstm_hidden_size": 4} if recurrent else {})}
    network = "MlpLstmPolicy" if recurrent else "MlpPolicy"
    options: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "policy_kwargs": net}
    model = kind(network, env, device="cpu", seed=0, **options).learn(16)
    for weight in model.policy.parameters():
        weight.data.normal_(0.0, 0.4)
    path, out = tmp_path / "model.zip", tmp_path / "policy.onnx"
    model.save(path)
    statistics: Any = env if normalizer == "around" else frames.venv
    if normalizer:
        statistics.save(str(tmp_path / "saved"))
    named = str(tmp_path / "saved") if normalizer else None
    runs.export_policy(path, out, "point_goal", None, trust=True, vecnormalize=named)
    policies: list[FilePolicy] = [OnnxPolicy(out)]
    assert policies[0].bundle is not None
    assert (policies[0].bundle.observation.normalizer is not None) == bool(normalizer)
    if not normalizer:
        policies.append(runs.load_policy(str(path), trust=True, env="point_goal"))
        runs.make_env(policies[1], "planar", None, {}).close()
    stacks: Any = frames.stacked_obs
    for episode in np.random.default_rng(0).uniform(-2.0, 2.0, (2, 6, 7)).astype(np.float32):
        state = None
        for policy in policies:
            policy.reset()
        for step, seen in enumerate(episode):
            once = (statistics.normalize_obs(seen) if normalizer == "inside" else seen)[None]
            stacked = (
                stacks.update(once, np.zeros(1, bool), [{}])[0] if step else stacks.reset(once)
            )
            given = statistics.normalize_obs(stacked) if normalizer == "around" else stacked
            begins = np.array([step == 0])
            expected, state = model.predict(given, state, begins, deterministic=True)
            for policy in policies:
                assert policy(seen) == pytest.approx(expected[0], abs=1e-5)
    env.close()


def test_training_goes_on_where_a_zip_ended(tmp_path: Path) -> None:
    from stable_baselines3 import PPO

    begun, out = tmp_path / "begun.zip", tmp_path / "out"
    model = PPO.load(save(begun, n_steps=32, batch_size=32, learning_rate=1e-5), device="cpu")
    model.num_timesteps = 1000
    model.save(begun)
    small = ["--trust", "--steps", "64", "--robots", "2", "--no-progress"]
    assert seeds.main(["--resume", str(begun), *small, "--out", str(out)]) == 0
    assert PPO.load(out / "model.zip", device="cpu").num_timesteps == 1064
    before, after = (ZipPolicy(path, trust=True) for path in (begun, out / "model.zip"))
    observation = np.full(7, 0.5, np.float32)
    assert after(observation) == pytest.approx(before(observation), abs=0.02)
    assert (after(observation) != before(observation)).any()
    assert after.env_id == "acsar_gym/PointGoal-v0"
    assert OnnxPolicy(out / "policy.onnx").bundle == after.bundle


def test_resuming_is_refused_in_one_line(good: Path, tmp_path: Path) -> None:
    sac = save(tmp_path / "sac.zip", "SAC", buffer_size=10)
    for zipped, more, said in (
        (good, "", "--trust"),
        (good, "--trust --env path_follow", "in acsar_gym/PathFollow-v0: train"),
        (sac, "--trust", "only PPO"),
    ):
        with pytest.raises(AcsarError, match=said) as refused:
            seeds.main(["--resume", str(zipped), *more.split(), "--out", str(tmp_path / "out")])
        assert "\n" not in str(refused.value)

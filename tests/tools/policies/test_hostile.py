"""Policy files as an attacker would make them: one line each, before they cost anything."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from onnx_tools import ENV_ID, GOOD, HOSTILE, bundle_of, relabelled

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy
from acsar_gym.tools.policies.policy import MAX_POLICY_BYTES


def refused(path: Path) -> str:
    """The one line with which a policy file is refused."""
    with pytest.raises(PolicyError) as raised:
        runs.make_env(runs.load_policy(str(path), trust=False), "planar", None, {})
    said = str(raised.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    assert len(said) < 400
    return said


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__)
def test_a_hostile_file_is_one_line(
    make: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("weights.bin").write_bytes(bytes(56))  # what external data would be taken from
    path = tmp_path / "policy.onnx"
    path.write_bytes(make())
    refused(path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"PK", "isn't an ONNX file but a zip"),
        (pickle.dumps([1]), "isn't a policy: must be an ONNX file"),
        (b"", "isn't a policy: must be an ONNX file"),
        (GOOD.read_bytes()[:900], "isn't a whole ONNX file: copy or export it again"),
    ],
    ids=["zip", "pickle", "empty", "cut"],
)
def test_what_is_no_onnx_file_is_named(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(content)
    with pytest.raises(PolicyError) as error:
        OnnxPolicy(path)
    assert str(error.value).startswith(f"{path}: {said}")


def test_only_a_model_is_asked_to_be_trusted(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    for names, trust, said in (
        (["data"], True, "isn't a policy: must be an ONNX file"),
        (["data", "policy.pth"], False, "pass --trust"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(name, "{}")
        with pytest.raises(PolicyError, match=said):
            ZipPolicy(path, trust=trust)


def test_devices_pipes_and_large_files_are_not_read(tmp_path: Path) -> None:
    pipe, large = tmp_path / "pipe.onnx", tmp_path / "large.onnx"
    os.mkfifo(pipe)
    with large.open("wb") as file:
        file.truncate(MAX_POLICY_BYTES + 1)
    assert "regular file" in refused(pipe)
    assert "larger than 32 MB" in refused(large)
    assert "regular file" in refused(Path("/dev/zero"))


@pytest.mark.parametrize("env_id", ["GymV21Environment-v0", "phys2d/CartPole-v1", "CartPole-v1"])
def test_a_file_chooses_among_the_environments_of_this_package_alone(
    env_id: str, tmp_path: Path
) -> None:
    path = relabelled(tmp_path / "other.onnx", env__id=env_id)
    assert "--env" in refused(path)
    policy = runs.load_policy(str(path), trust=False, env=ENV_ID)
    runs.make_env(policy, "planar", None, {}).close()
    with pytest.raises(ConfigError, match="no_such_module"):
        runs.load_policy(str(path), trust=False, env="no_such_module:x-v0")


def test_what_a_file_says_cannot_steer_a_terminal(tmp_path: Path) -> None:
    names = [f"\x1b]0;{name}\x07" for name in bundle_of().observation.names]
    for values in ({"env__id": "\x1b[2Jx"}, {"observation__names": names}):
        path = relabelled(tmp_path / "escape.onnx", **values)
        assert "\x1b" not in refused(path)

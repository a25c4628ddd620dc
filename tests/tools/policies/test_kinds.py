"""Files that are given as policies: what they are is said in one line, and nothing in them runs."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import pytest
from onnx_tools import GOOD

from acsar_gym.errors import PolicyError
from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy, kinds
from acsar_gym.tools.policies.onnx import read_bundle


def zipped(path: Path, *names: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, "{}")
    return path


def write_files(folder: Path) -> dict[str, Path]:
    files = {
        "model": zipped(folder / "model.zip", "data", "policy.pth", "pytorch_variables.pth"),
        "any": zipped(folder / "any.zip", "data"),
        "torch": zipped(folder / "x.pt", "x/data.pkl", "x/version"),
    }
    contents = {
        "pickle": pickle.dumps([1]),
        "text": b"hello",
        "empty": b"",
        "cut": GOOD.read_bytes()[:900],
        "cut_zip": files["any"].read_bytes()[:-10],
    }
    for name, content in contents.items():
        files[name] = folder / f"{name}.policy"
        files[name].write_bytes(content)
    return files


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("model", "a zip of stable-baselines3, which can run code when it's loaded: convert it"),
        ("any", "isn't a policy but a zip without a model of stable-baselines3: must be an ONNX"),
        ("torch", "isn't a policy but what torch.save writes, which can run code"),
        ("pickle", "isn't a policy but a pickle"),
        ("text", "isn't a policy: must be an ONNX file"),
        ("empty", "isn't a policy: must be an ONNX file"),
        ("cut", "isn't a whole ONNX file: copy or export it again"),
        ("cut_zip", "isn't a policy but a damaged zip: must be an ONNX file"),
    ],
)
def test_what_is_no_onnx_file_is_named(name: str, said: str, tmp_path: Path) -> None:
    path = write_files(tmp_path)[name]
    for read in (read_bundle, OnnxPolicy):
        with pytest.raises(PolicyError) as error:
            read(path)
        assert str(error.value).startswith(f"{path}: {said}")
        assert "\n" not in str(error.value)


def test_only_a_model_is_asked_to_be_trusted(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    for trust in (False, True):
        with pytest.raises(PolicyError, match="a zip without a model"):
            ZipPolicy(files["any"], trust=trust)
    with pytest.raises(PolicyError, match="pass --trust"):
        ZipPolicy(files["model"])
    assert kinds.describe_other_file(GOOD.read_bytes()) is None

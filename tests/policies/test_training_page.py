"""docs/training.md: its blocks of code, where the library is in the dev extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import snippets

from acsar_gym.evaluation import runs
from acsar_gym.policies import OnnxPolicy

pytestmark = pytest.mark.xdist_group("torch")
TINY = {"256": "4", "n_steps=64": "n_steps=8", "batch_size=4096": "batch_size=32", "300_000": "32"}


def test_every_way_has_its_block() -> None:
    ways = ["both ways", "stable-baselines3", "RLlib", "torch", "mine.py"]
    assert list(snippets.snippets()) == ways


def execute(name: str, smaller: dict[str, str]) -> None:
    """Run a block in this process, which has imported torch already."""
    exec(compile(snippets.shrunk(name, smaller), name, "exec"), {})  # noqa: S102 - our own


def test_both_ways() -> None:
    execute("both ways", {"256": "2"})


def test_stable_baselines3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    execute("stable-baselines3", TINY)
    runs.export(tmp_path / "model.zip", tmp_path / "p.onnx", "point_goal", None, trust=True)
    assert OnnxPolicy(tmp_path / "p.onnx").env_id == "acsar_gym/PointGoal-v0"


def test_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    execute("torch", {})
    assert OnnxPolicy(tmp_path / "policy.onnx")(np.ones(7, np.float32)).shape == (2,)


def test_a_function(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(snippets.snippets()["mine.py"][1])
    policy = runs.load(f"{tmp_path / 'mine.py'}:act", trust=False)
    results = runs.drive(policy, "planar", None, range(3))
    assert all(result.success for result in results.results)

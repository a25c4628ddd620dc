"""The recipes of every algorithm, from `train` to `evaluate`, as the commands run them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("torch")]


@pytest.mark.parametrize("algo", ["ppo", "sac", "tqc", "ppo_lstm"])
def test_what_a_recipe_trains_can_be_evaluated(algo: str, call: Call, tmp_path: Path) -> None:
    """A few thousand steps: it needn't drive well."""
    small = ("--steps", "4000", "--robots", "32", "--threads", "1", "--no-progress")
    code, _, error = call("train", "--algo", algo, "--env", "point_goal", *small, "--out", tmp_path)
    assert code == 0, error
    table = tmp_path / "results.json"
    asked = ("--link", "planar", "--episodes", "3", "--json", table)
    code, _, error = call("evaluate", "--policy", tmp_path / "policy.onnx", *asked)
    assert code == 0, error
    assert json.loads(table.read_text())["episodes"] == 3

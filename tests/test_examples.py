"""agents/examples, where the library is in the dev extra; the others: `make test-ecosystem`."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from acsar_gym.evaluation import runs
from acsar_gym.policies import OnnxPolicy

EXAMPLES = Path(__file__).resolve().parents[1] / "agents" / "examples"


@pytest.mark.parametrize(("env", "least"), [("point_goal", 5), ("obstacle_goal", 0)])
def test_heading_for_the_goal_reaches_it_where_nothing_stands_in_the_way(
    env: str, least: int
) -> None:
    policy = runs.load(f"{EXAMPLES / 'head_for_goal.py'}:act", trust=False, env=env)
    done = runs.drive(policy, "planar", None, range(5))
    assert least <= sum(result.success for result in done.results) < 5 + bool(least)


@pytest.mark.xdist_group("torch")
def test_the_export_of_stable_baselines3_drives(tmp_path: Path) -> None:
    out = tmp_path / "policy.onnx"
    script = runpy.run_path(str(EXAMPLES / "sb3_ppo.py"))
    script["main"](["--steps", "16", "--robots", "4", "--rollout", "4", "--out", str(out)])
    assert OnnxPolicy(out).env_id == "acsar_gym/PointGoal-v0"

"""agents/examples, if the library is in the dev extra. `make test-ecosystem` runs the others."""

from __future__ import annotations

import importlib
import os
import runpy
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from recording_tools import record_env
from serial_tools import Emulated, RobotFile

from acsar_gym import RobotConfig
from acsar_gym.testing import wait_until
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import OnnxPolicy

os.environ.setdefault("MPLBACKEND", "Agg")
EXAMPLES = Path(__file__).resolve().parents[1] / "agents" / "examples"


def main_of(name: str) -> Any:
    """The `main` of an example, which its command line calls."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]


@pytest.mark.parametrize(("env", "fewest"), [("point_goal", 5), ("obstacle_goal", 0)])
def test_head_for_goal_reaches_it_without_obstacles(env: str, fewest: int) -> None:
    policy = runs.load_policy(f"{EXAMPLES / 'head_for_goal.py'}:act", trust=False, env=env)
    done = runs.evaluate_policy(policy, "planar", None, range(5))
    assert fewest <= sum(result.success for result in done.results) < 5 + bool(fewest)


@pytest.mark.xdist_group(__name__)
def test_sb3_ppo_exports_a_policy(tmp_path: Path) -> None:
    out = tmp_path / "policy.onnx"
    main_of("sb3_ppo")(steps=16, robots=4, rollout=4, out=str(out))
    assert OnnxPolicy(out).env_id == "acsar_gym/PointGoal-v0"
    assert out.with_suffix(".zip").exists()


@pytest.mark.xdist_group(__name__)
def test_own_loop_learns_from_a_rollout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main_of("own_loop")(steps=1)
    assert "16,384 steps, mean reward of a step " in capsys.readouterr().out
    assert OnnxPolicy(tmp_path / "own.onnx").env_id == "acsar_gym/PointGoal-v0"


@pytest.mark.xdist_group(__name__)
def test_own_task_is_trained_and_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))  # the id names its class by the module
    try:
        importlib.import_module("own_task").main(steps=1, count=1)
    finally:
        gymnasium.registry.pop("mine/Parking-v0", None)
    assert capsys.readouterr().out.startswith("planar: parked in ")
    assert OnnxPolicy(tmp_path / "parking.onnx").env_id == "mine/Parking-v0"


@pytest.mark.xdist_group(__name__)
@pytest.mark.parametrize("action", [5.0, -5.0], ids=["ahead", "back"])
def test_sb3_on_hardware_is_slow_and_stops(
    action: float,
    emulator: Emulated,
    robot_file: RobotFile,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A policy that wants full speed, and a robot whose file allows it."""
    zipped = full_speed(tmp_path / "model.zip", action)
    robot = robot_file(linear_limits={"min_velocity": -1.0, "max_velocity": 1.0})
    main_of("sb3_on_hardware")(zipped, emulator.device, robot=str(robot), seconds=1.0, yes=True)
    wait_until(emulator.is_stopped, "the command to stop")
    speeds = [abs(speed or 0.0) for command in emulator.commands() for speed in command]
    assert max(speeds) == pytest.approx(0.2 / RobotConfig.preset("acsar").wheel_radius, abs=0.01)
    output = capsys.readouterr().out
    assert output.startswith("reached: ")
    assert output.endswith("limited by LIMITS; no fault\n")


@pytest.mark.xdist_group(__name__)
def test_clone_behaviour_clones_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main_of("clone_behaviour")(out=tmp_path, drives=10)
    output = capsys.readouterr().out
    assert "/data: 10 drives, " in output
    assert "success 100%" in output
    assert OnnxPolicy(tmp_path / "policy.onnx").env_id == "acsar_gym/PointGoal-v0"


def full_speed(path: Path, action: float) -> Path:
    """A zip of a network that always drives straight, ahead or back."""
    import torch
    from stable_baselines3 import PPO

    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar")
    model = PPO("MlpPolicy", env, n_steps=2, batch_size=2, device="cpu")
    last: Any = model.policy.action_net
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor([action, 0.0]))
    model.save(path)
    return path


def test_recorded_run_shows_figures_in_pandas(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "run.png"
    figures = main_of("recorded_run")(record_env(tmp_path / "tape.mcap", "point_goal"), plot)
    assert list(figures.columns) == [0, 1]
    assert 0.0 < figures.loc["measured after sent", 0] < 0.3
    assert 0.1 < figures.loc["path by odometry", 1] < 1.0
    assert figures.loc["late, median"].isna().all()
    assert "limited ticks" in capsys.readouterr().out
    assert plot.stat().st_size > 10_000

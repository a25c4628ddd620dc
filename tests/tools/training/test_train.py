"""`train` with its algorithms, targets and messages, on a tiny budget."""

from __future__ import annotations

import csv
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import yaml
from policy_tools import tiny
from serial_tools import CLI, TIMEOUT

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.plan import TrainingPlan
from acsar_gym.tools.training.run import sigterm_interrupts, train
from acsar_gym.vector.threads import usable_cores

pytestmark = pytest.mark.xdist_group(__name__)

WITHOUT = """
import runpy, sys

class Hidden:
    def find_spec(self, name, path, target=None):
        if name == hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

hidden = sys.argv.pop(1)
sys.meta_path.insert(0, Hidden())
runpy.run_path(sys.argv.pop(1), run_name="__main__")
"""
"""Runs the program in argv[2] as if the module in argv[1] weren't installed."""
SMALL: dict[str, Any] = {"n_timesteps": 64, "n_envs": 4, "policy_kwargs": {"net_arch": [8]}}
RECIPES: dict[str, Any] = {
    "sac": SMALL | {"learning_starts": 8},
    "tqc": SMALL | {"learning_starts": 8, "policy_kwargs": {"net_arch": [8], "n_quantiles": 5}},
    "ppo_lstm": SMALL
    | {"policy": "MlpLstmPolicy", "n_steps": 16, "batch_size": 32, "n_epochs": 1}
    | {"policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 8}},
}


@pytest.mark.parametrize("algo", RECIPES)
def test_train_writes_a_policy_that_decides_as_its_model(algo: str, tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yml"
    out = tmp_path / "out"
    recipe.write_text(yaml.safe_dump({"default": RECIPES[algo]}))
    train(tiny(out, algo=algo, conf_file=recipe))

    policy = OnnxPolicy(out / "policy.onnx")
    model = ZipPolicy(out / "model.zip", trust=True)
    assert policy.document == model.document
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 7)).astype(np.float32)
    actions = [policy(observation) for observation in observations]
    for observation, action in zip(observations, actions, strict=True):
        assert model(observation) == pytest.approx(action, abs=1e-5)
    policy.reset()
    assert policy(observations[0]) == pytest.approx(actions[0], abs=1e-6)
    assert (policy(observations[0]) == actions[0]).all() == (algo != "ppo_lstm")


def test_train_refuses_cuda_without_a_device(tmp_path: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is CUDA here")
    with pytest.raises(ConfigError, match=r"--device cuda: torch .* leave --device out"):
        train(tiny(tmp_path, device="cuda"))


def test_train_names_a_missing_extra() -> None:
    command = [sys.executable, "-c", WITHOUT, "onnxscript", str(AGENTS / "train.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("acsar-gym: training needs an extra, in the checkout: ")
    assert done.stderr.count("\n") == 1


def test_train_saves_at_sigterm(tmp_path: Path) -> None:
    command = [*CLI, "train", "--steps", "1e8", "--robots", "16", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("training on an open floor; ")
            assert "held-out success" in process.stdout.readline()
            started = psutil.Process(process.pid).children(recursive=True)
            process.send_signal(signal.SIGTERM)
            output = process.stdout.read().splitlines()
            process.wait(TIMEOUT)
        finally:
            process.kill()

        assert process.returncode == 128 + signal.SIGTERM
    assert started == []
    words = [line.split(" ")[0] for line in output if line and "held-out" not in line]
    assert words == ["interrupted", "written:"]
    assert (tmp_path / "policy.onnx").stat().st_size > 1000
    assert (tmp_path / "model.zip").stat().st_size > 1000


def test_sigterm_interrupts_unless_it_is_ignored() -> None:
    handler = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with sigterm_interrupts():
            signal.raise_signal(signal.SIGTERM)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with pytest.raises(KeyboardInterrupt, match="SIGTERM"), sigterm_interrupts():
            signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, handler)


def test_train_ends_at_its_target_and_prints_the_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "my runs"
    result = train(tiny(out, steps=100_000, target=0.0, progress=True))
    # rich before 15 ends bars with an empty line.
    lines = filter(None, capsys.readouterr().out.splitlines())
    first, progress, written, score, following = lines
    assert first == "training on an open floor; 1 thread, seed 3"
    assert progress.startswith("256 of 100,000 steps, held-out success ")
    assert written.startswith(f"written: {out / 'policy.onnx'}")
    assert score.startswith("held-out success: ")
    assert score.endswith("; target of 0.0% reached at 256 steps")
    assert " of 512 episodes (" in score
    assert following == f"next: acsar-gym evaluate --policy '{out / 'policy.onnx'}'"

    names = {"policy.onnx", "model.zip", "tensorboard", "config.yml", "learning_curve.csv"}
    assert {path.name for path in out.iterdir()} == names | {"learning_curve.png"}
    with (out / "learning_curve.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert [float(row[name]) for name in ("steps", "success_rate")] == [256, result.score[2]]


def test_train_prints_measured_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lag = {"low": 0.1, "high": 0.12, "method": "identify"}
    robot = RobotConfig.preset("acsar").with_(
        motor={"time_constant": 0.11},
        measured={"motor.time_constant": lag},
        motor_fit="doesn't fit: saturates at 6.0 rad/s",
    )
    robot.save(tmp_path / "robot.yaml")
    train(tiny(tmp_path / "out", steps=1, robots=4, robot=str(tmp_path / "robot.yaml")))

    first, misfit, *_ = capsys.readouterr().out.splitlines()
    assert "seed 3; randomized as measured: motor_lag 0.909 to 1.09; by default widths: " in first
    assert misfit.endswith(
        "robot.yaml: this robot's simulation doesn't fit: saturates at 6.0 rad/s"
    )
    document = OnnxPolicy(tmp_path / "out/policy.onnx").document
    assert document.robot["motor.time_constant"] == pytest.approx((0.1, 0.12))


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"steps": 100_000, "robots": 512, "env": "obstacle_goal"}, "--robots 104 or fewer"),
        ({"steps": 4096, "robots": 512, "algo": "sac"}, "512 robots are only 8"),
        ({"steps": 100_000, "robots": 16, "env": "obstacle_goal"}, ""),
        ({"steps": 1, "robots": 4}, ""),
    ],
)
def test_update_hint_reports_few_updates(options: dict[str, Any], hint: str) -> None:
    line = TrainingPlan.of(TrainingOptions(threads=1, **options)).update_hint
    assert hint in line
    assert bool(line) == bool(hint)


def test_update_hint_knows_the_default_of_the_algorithm(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yml"
    recipe.write_text("default: {n_timesteps: 300000, n_envs: 64}", encoding="utf-8")
    line = TrainingPlan.of(TrainingOptions(conf_file=recipe, threads=1)).update_hint
    assert "64 robots are only 3 updates" in line  # of 2,048 steps

    recipe.write_text("default: {n_timesteps: 1000, n_envs: 4, n_steps: 0}", encoding="utf-8")
    assert not TrainingPlan.of(TrainingOptions(conf_file=recipe, threads=1)).update_hint


def test_training_plan_takes_the_ranges_of_the_recipe(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yml"
    text = "{env_kwargs: {randomization: {friction: [0.7, 1.2]}}, n_timesteps: 1, n_envs: 4}"
    recipe.write_text(f"acsar_gym/PointGoal-v0: {text}", encoding="utf-8")
    options = TrainingOptions(conf_file=recipe)
    plan = TrainingPlan.of(options)
    assert plan.randomization == {"friction": [0.7, 1.2]}
    assert plan.threads == usable_cores()
    plan.make_held_out_batch(plan.make_training_batch()).close()

    fixed = TrainingPlan.of(options.model_copy(update={"randomize": False, "threads": 1}))
    assert (fixed.randomization, fixed.threads) == (False, 1)
    for name, value, message in (
        ("threads", 0, "--threads 0: must be 1"),
        ("worlds", ("clutter",), "--worlds: point_goal has none"),
    ):
        with pytest.raises(ConfigError, match=message):
            TrainingPlan.of(options.model_copy(update={name: value}))
